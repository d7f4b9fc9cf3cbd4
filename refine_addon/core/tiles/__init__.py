"""Many files as one scene, larger than memory: one ranking and one budget over all of them.

`prune` is the entry. `source` copies each property of all files into one array on the disk
(`core.mapped`), on which the code for a single file works. `cluster` runs work on Dask, `writing`
writes all tiles or none, and `storage` opens URLs.
"""
