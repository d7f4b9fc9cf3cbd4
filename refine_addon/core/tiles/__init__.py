"""Many files as one scene, larger than memory: one ranking and one budget over all of them.

`prune` is the entry. `source` copies the files' columns into one array each, on the disk
(`core.mapped`), so the rest is the code for a single file; what would need all splats in memory
goes region by region. `cluster` runs work on Dask, `writing` writes all tiles or none, `storage`
opens URLs.
"""
