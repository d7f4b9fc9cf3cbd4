"""Many files as one scene, larger than memory: one ranking and one budget over all of them.

`prune` is the entry. `source` copies the columns of all files into one array each, on the disk, so
the rest is the code for a single file (`core.mapped`). `cluster` runs work on Dask, `writing`
writes all tiles or none, `storage` opens URLs.
"""
