"""Many files as one scene, larger than memory: one ranking and one budget over all of them.

`prune` is the entry. `files` copies each property of all files into one array on the disk
(`core.mapped`), on which the code for a single file works, and writes all tiles or none. `cluster`
runs work on Dask, and `storage` opens URLs.
"""
