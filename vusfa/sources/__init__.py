"""Making rooms: capture from a simulator, photographs or a renderer; features; downloads.

Nothing here is needed to train in rooms that exist: :mod:`vusfa.scenes` reads them.
"""
