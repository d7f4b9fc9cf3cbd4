"""Many files as one scene, larger than memory: one ranking and one budget over all of them.

`prune` is the way through. `units` cuts the files into runs of rows, `folder` keeps what stands
between the steps, and `workers` does the steps in this process or `cluster` on a Dask cluster. A
step is a class with `run`: of the closed form in `closed_form`, of what views see in `gaussians`
and `seeing`, of absorbing in `regions`, of the selection in `selecting`, and of the tiles in
`writing`.
"""
