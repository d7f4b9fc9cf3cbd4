"""Many files as one scene, larger than memory: one ranking and one budget over all of them.

`prune` is the way through. `source` copies the files' columns into files of the job (`job`), where
they are one array each (`core.mapped`): so everything else is the code that prunes a single file.
Only what would need all splats in memory at once is done region by region (`core.mapped`).
`cluster` has work done by Dask, `writing` writes all tiles or none, `storage` opens URLs.
"""
