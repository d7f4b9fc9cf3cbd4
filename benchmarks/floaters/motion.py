"""Recipe c: motion, reflections, mis-posed photos. Clumps are upright ghosts smeared along a path; singles are copies
of true splats, seen through a wrong pose or mirrored; needles radiate away from the cameras in bundles; veils
cover half a picture (flare, sky, a passer-by at the edge)."""

import numpy as np

from .geometry import *


def rodrigues(a, t):
    a = a / np.linalg.norm(a)
    K = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    return np.eye(3) + np.sin(t) * K + (1 - np.cos(t)) * K @ K


def qmul(a, b):
    w, x, y, z = a.T
    W, X, Y, Z = b.T
    return np.stack(
        [
            w * W - x * X - y * Y - z * Z,
            w * X + x * W + y * Z - z * Y,
            w * Y - x * Z + y * W + z * X,
            w * Z + x * Y - y * X + z * W,
        ],
        1,
    )


def make(ply_path, cameras_json_path, count, seed):
    rng = np.random.default_rng([seed, 0xC])
    sc = Scene(ply_path, cameras_json_path)
    S, up = sc.S, sc.up
    ns, nc, nn, nv = counts(count)
    Q = np.stack([sc.v[f"rot_{i}"] for i in range(4)], 1).astype(float)
    Q /= np.linalg.norm(Q, axis=1, keepdims=True) + 1e-12
    solid = np.flatnonzero(sc.ok & (sc.op > 0.05))

    # singles: what one camera sees, put where a wrong pose / a mirror / a pull towards the lens has it
    def ghosts():
        k = rng.integers(sc.n)
        idx = rng.choice(solid, 1500)
        u, v, z = sc.project(k, sc.xyz[idx])
        m = (z > 0.05 * S) & (u >= 0) & (u < sc.W[k]) & (v >= 0) & (v < sc.H[k])
        idx, z = idx[m], z[m]
        if not len(idx):
            return np.zeros((0, 3)), idx, np.zeros((0, 4)), z
        p = sc.xyz[idx]
        Rw = rodrigues(rng.normal(size=3), np.deg2rad(rng.uniform(2, 9)))
        qr = quat_from_axes(Rw[None])
        how = rng.random()
        f = 1.0
        if how < 0.6:  # wrong pose, and depth pulled in
            f = rng.uniform(0.35, 0.85)
            p = sc.C[k] + (p - sc.C[k]) @ Rw.T * f + rng.normal(0, 0.03 * S, 3)
        elif how < 0.8:  # mirrored in an upright plane before the camera
            n = np.cross(up, rng.normal(size=3))
            n /= np.linalg.norm(n)
            o = sc.C[k] + sc.R[k][:, 2] * rng.uniform(0.3, 0.9) * S
            p = p - 2 * ((p - o) @ n)[:, None] * n
        else:  # flecks left along a path before the surface
            p = sc.C[k] + (p - sc.C[k]) * (1 - rng.beta(1.2, 5, (len(p), 1)) - 0.06)
        g = np.flatnonzero(sc.free(p, 2, 0.92, 0.05, 0.3))
        g = rng.permutation(g)[: max(8, ns // 25)]
        return p[g], idx[g], qmul(np.repeat(qr, len(g), 0), Q[idx[g]]), np.full(len(g), f)

    parts = []
    X, idx, q, f = gather(ns, ghosts)
    sca = (
        np.exp(np.clip(sc.logs[idx], np.log(1e-4 * S), np.log(0.05 * S)))
        * f[:, None]
        * np.exp(rng.normal(0.15, 0.25, (ns, 1)))
    )
    top = sca.max(1, keepdims=True)
    sca = np.clip(sca, top / 6, np.maximum(top, 0.003 * S)) * np.maximum(
        1, 0.003 * S / top
    )  # nothing needle-like, nothing under notice
    al = sc.op[idx] * rng.beta(2, 3, ns)
    parts.append(
        (
            sc.rows(
                X,
                np.maximum(al, 0.02),
                sca,
                q,
                sc.dc[idx] + rng.normal(0, 0.1, (ns, 3)),
                0.6 * np.clip(sc.rest_raw(idx), -0.25, 0.25),
            ),
            "single",
        )
    )

    # clumps: a body of several stacked parts, seen at a few places of its walk
    def spot(least=3, agree=0.4, margin=0.85):
        def draw():
            k = rng.integers(sc.n, size=400)
            X = np.empty((400, 3))
            for c in np.unique(k):
                m = k == c
                u, v = (
                    rng.uniform(0.1, 0.9, m.sum()) * sc.W[c],
                    rng.uniform(0.1, 0.9, m.sum()) * sc.H[c],
                )
                D, _ = sc.behind(c, u, v)
                X[m] = sc.unproject(c, u, v, np.minimum(D, 3 * S) * rng.uniform(0.35, 0.9, m.sum()))
            return (X[sc.free(X, least, margin, 0.08, agree)],)

        return draw

    nb = int(min(max(1, nc // 5), 10))
    P, B, DCs, AL, QQ = [], [], [], [], []
    for m in sizes_of(rng, nc, nb, 3.0):
        if not m:
            continue
        for _ in range(200):
            (c,) = (a[:1] for a in gather(1, spot()))
            hgt = S * rng.uniform(0.03, 0.085)
            wid = hgt * rng.uniform(0.2, 0.5)
            path = np.cross(up, rng.normal(size=3))
            path *= wid * rng.uniform(0.5, 3) / np.linalg.norm(path)
            steps = rng.integers(1, 4)
            t = rng.uniform(0.05, 0.85, (3, 3))  # head, trunk, legs; clothes are mostly muted
            g3 = t.mean(1, keepdims=True)
            cloth = (g3 + 0.4 * (t - g3) - 0.5) / C0

            def draw():
                n = 300
                h = rng.uniform(-1, 1, n)
                side = rng.normal(size=(n, 3))
                side -= (side @ up)[:, None] * up
                side *= (
                    wid
                    * (1 - 0.5 * np.abs(h))[:, None]
                    / (np.linalg.norm(side, axis=1, keepdims=True))
                    * rng.uniform(0.6, 1, (n, 1))
                )
                st = rng.integers(0, steps, n)
                Y = c + h[:, None] * hgt * up + side + (st - (steps - 1) / 2)[:, None] * path
                part = np.where(h > 0.6, 0, np.where(h > -0.1, 1, 2))
                g = sc.free(Y, 2, 0.95, 0.05, 0.2)
                return Y[g], cloth[part[g]], st[g], np.full(g.sum(), wid), side[g]

            try:
                Y, col, st, wd, side = gather(m, draw, 15)
                break
            except RuntimeError:
                continue
        P.append(Y)
        DCs.append(col + 0.6 * rng.normal(0, 0.2, (m, 3)))
        AL.append(rng.beta(3, 3, m) / (1 + 0.5 * st))  # the longer stand stays the more opaque
        B.append(wd * np.exp(rng.normal(np.log(0.3), 0.35, m)))
        QQ.append(quat_along(rng, side + 1e-3 * wid * rng.normal(size=side.shape)))
    P, B, DCs, AL, QQ = map(np.concatenate, (P, B, DCs, AL, QQ))
    sca = (
        B[:, None] * np.array([0.45, 1, 1]) * np.exp(rng.normal(0, 0.3, (len(P), 3)))
    )  # flakes of the body's skin
    src = rng.choice(solid, len(P))
    parts.append(
        (sc.rows(P, AL, sca, QQ, DCs, 0.4 * np.clip(sc.rest_raw(src), -0.25, 0.25)), "cluster")
    )

    # needles: bundles radiating away from the cameras, at the far side of free space
    def bundle():
        (c,) = (a[:1] for a in gather(1, spot(2, 0.3, 0.9)))
        k = np.argsort(((sc.C - c) ** 2).sum(1))[rng.integers(min(4, sc.n))]
        n = rng.integers(2, 9)
        d0 = c - sc.C[k]
        Y = c + rng.normal(size=(n, 3)) * 0.06 * np.linalg.norm(d0)
        D = Y - sc.C[k]
        D /= np.linalg.norm(D, axis=1, keepdims=True)
        if rng.random() < 0.3:  # away from the middle of all cameras: the sky's and the rim's
            D = Y - sc.C.mean(0)
            D /= np.linalg.norm(D, axis=1, keepdims=True) + 1e-9
        D += rng.normal(0, 0.1, D.shape)
        g = sc.free(Y, 2, 0.93, 0.05, 0.3)
        u, v, z = sc.project(k, Y)
        _, col = sc.behind(k, u, v)
        L = np.linalg.norm(Y - sc.C[k], axis=1) * np.exp(rng.normal(np.log(0.07), 0.5, n))
        return Y[g], D[g], col[g], np.minimum(L, 0.3 * S)[g]

    X, D, col, L = gather(nn, bundle, 4000)
    asp = np.exp(rng.uniform(np.log(10), np.log(80), nn))
    sca = np.stack([L, L / asp, L / asp * rng.uniform(0.5, 1, nn)], 1)
    sky = rng.random((nn, 1)) < 0.25
    col = np.where(sky, (np.array([0.75, 0.82, 0.92]) - 0.5) / C0, col) + rng.normal(
        0, 0.15, (nn, 3)
    )
    src = rng.choice(solid, nn)
    parts.append(
        (
            sc.rows(
                X,
                rng.beta(2, 2.5, nn),
                sca,
                quat_along(rng, D),
                col,
                0.5 * np.clip(sc.rest_raw(src), -0.25, 0.25),
            ),
            "needle",
        )
    )

    # veils: one half of a picture
    def half():
        k = rng.integers(sc.n)
        side, axis = rng.choice([-1, 1]), rng.random() < 0.6
        a = 0.5 + side * rng.uniform(0.15, 0.3)
        o = rng.uniform(0.35, 0.65)
        u, v = np.array([a if axis else o]) * sc.W[k], np.array([o if axis else a]) * sc.H[k]
        D, _ = sc.behind(k, u, v)
        z = np.minimum(D, 2.5 * S) * rng.uniform(0.25, 0.7)
        X = sc.unproject(k, u, v, z)
        g = sc.free(X, 2, 0.9, 0.1, 0.25)
        return X[g], z[g], np.full(g.sum(), k), np.full(g.sum(), axis), np.full(g.sum(), side)

    X, z, k, axis, side = gather(nv, half, 4000)
    hw, hh = sc.W[k] / sc.fx[k] * z, sc.H[k] / sc.fy[k] * z  # the picture's width and height there
    sx = (
        np.where(axis, 0.13, 0.25) * hw * rng.uniform(0.8, 1.3, nv)
    )  # two sigma each way: half the picture
    sy = np.where(axis, 0.25, 0.13) * hh * rng.uniform(0.8, 1.3, nv)
    M = (
        sc.R[k] @ np.stack([rodrigues(rng.normal(size=3), rng.normal(0, 0.2)) for _ in range(nv)])
        if nv
        else np.zeros((0, 3, 3))
    )
    sca = np.stack([sx, sy, np.minimum(sx, sy) * rng.uniform(0.02, 0.3, nv)], 1)
    pal = np.array([[0.8, 0.86, 0.95], [0.95, 0.9, 0.75], [0.25, 0.22, 0.2], [0.6, 0.6, 0.6]])
    col = (pal[rng.integers(4, size=nv)] + rng.normal(0, 0.04, (nv, 3)) - 0.5) / C0
    parts.append(
        (
            sc.rows(
                X,
                rng.uniform(0.02, 0.2, nv),
                sca,
                quat_from_axes(M),
                col,
                rng.normal(0, 0.02, (nv, sc.nrest)),
            ),
            "veil",
        )
    )
    return finish(rng, parts)
