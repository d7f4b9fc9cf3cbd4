"""Many files as one scene, larger than memory: one ranking and one budget over all of them.

`units` cuts the files into runs of rows, `steps` does one step with one run, `folder` keeps what
stands between the steps, `prune` puts the steps together, and `workers` does them in this process;
`cluster` does them on a Dask cluster.
"""
