"""Recipe a: floaters uniform in the free volume. Left-overs of densification: positions, directions and colours
owe nothing to any single camera."""

import numpy as np

from .geometry import *


def make(ply_path, cameras_json_path, count, seed):
    rng = np.random.default_rng([seed, 0xA])
    sc = Scene(ply_path, cameras_json_path)
    S = sc.S
    ns, nc, nn, nv = counts(count)
    near = sc.xyz[sc.ok & (sc.op > 0.3)]
    dmin = np.min([((near - c) ** 2).sum(1) for c in sc.C], 0) ** 0.5
    near = near[dmin < 2.5 * S]  # the part of the scene the cameras are about
    lo = np.minimum(np.percentile(near, 2, 0), sc.C.min(0))
    hi = np.maximum(np.percentile(near, 98, 0), sc.C.max(0))

    def uniform(least, agree=0.3, margin=0.9):
        def draw():
            X = rng.uniform(lo, hi, (4000, 3))
            return (X[sc.free(X, least, margin, near=0.08, agree=agree)],)

        return draw

    solid = np.flatnonzero(sc.ok & (sc.op > 0.3))

    def colours(n):  # half greyish mist, half colours of the scene
        grey = (rng.normal(0.5, 0.17, (n, 1)) + rng.normal(0, 0.03, (n, 3)) - 0.5) / C0
        own = sc.dc[rng.choice(solid, n)] + rng.normal(0, 0.25, (n, 3))
        return np.clip(np.where(rng.random((n, 1)) < 0.5, grey, own), -1.9, 2.6)

    def harmonics(n, s=0.03):
        if not sc.nrest:
            return None
        K = sc.nrest // 3
        l = np.floor(np.sqrt(np.arange(1, K + 1)))
        return rng.normal(0, s, (n, sc.nrest)) / np.tile(l, 3)

    def alpha(n, haze=0.6):  # most faint, a tail of opaque ones
        return np.where(rng.random(n) < haze, rng.beta(1.6, 9, n) + 0.02, rng.beta(2.2, 2.0, n))

    parts = []
    (X,) = gather(ns, uniform(3))
    base = S * np.exp(rng.normal(np.log(0.009), 0.6, ns))
    sca = base[:, None] * np.exp(rng.normal(0, 0.35, (ns, 3)))
    parts.append(
        (sc.rows(X, alpha(ns), sca, rand_quat(rng, ns), colours(ns), harmonics(ns)), "single")
    )

    nb = int(min(max(1, nc // 5), 10))
    size = sizes_of(rng, nc, nb)
    (cen,) = gather(nb, uniform(4, 0.5, 0.8))
    P, B, Ccol = [], [], []
    for m, c, col in zip(size, cen, colours(nb)):  # round blobs
        r = S * rng.uniform(0.012, 0.04) * np.array([1, 1, 1.0]) * np.exp(rng.normal(0, 0.25, 3))
        got = (
            gather(
                m,
                lambda: (lambda Y: (Y[sc.free(Y, 2, 0.95, 0.05, 0.2)],))(
                    c + rng.normal(size=(200, 3)) * r
                ),
            )
            if m
            else (np.zeros((0, 3)),)
        )
        P.append(got[0])
        B.append(np.full(m, r.mean() * rng.uniform(0.2, 0.5)))
        Ccol.append(col + rng.normal(0, 0.15, (m, 3)))
    P, B, Ccol = np.concatenate(P), np.concatenate(B), np.concatenate(Ccol)
    sca = B[:, None] * np.exp(rng.normal(0, 0.45, (nc, 3)))
    parts.append(
        (sc.rows(P, alpha(nc, 0.35), sca, rand_quat(rng, nc), Ccol, harmonics(nc)), "cluster")
    )

    (X,) = gather(nn, uniform(3))  # needles in any direction
    L = S * np.exp(rng.normal(np.log(0.035), 0.5, nn))
    asp = np.exp(rng.uniform(np.log(8), np.log(50), nn))
    sca = np.stack([L, L / asp, L / asp * np.exp(rng.normal(-0.2, 0.3, nn))], 1)
    parts.append(
        (sc.rows(X, alpha(nn, 0.5), sca, rand_quat(rng, nn), colours(nn), harmonics(nn)), "needle")
    )

    (X,) = gather(nv, uniform(3, 0.4, 0.8))  # thin sheets of mist
    L = S * rng.uniform(0.15, 0.4, nv)
    sca = np.stack([L, L * rng.uniform(0.5, 1, nv), L * rng.uniform(0.02, 0.15, nv)], 1)
    parts.append(
        (
            sc.rows(
                X,
                rng.uniform(0.02, 0.15, nv),
                sca,
                rand_quat(rng, nv),
                colours(nv),
                harmonics(nv, 0.02),
            ),
            "veil",
        )
    )
    return finish(rng, parts)
