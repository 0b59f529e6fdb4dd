"""Speed of the library beside its alternatives: python benchmarks/run.py --help"""
