"""Experiments: manifests of episodes, results on disk, tables and figures made from them."""
