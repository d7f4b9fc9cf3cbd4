"""Recipe b: floaters of single photos. A few cameras (bad exposure, lone views) carry most of them; they lie on those
cameras' rays, near the lens, wear the colour of what is behind them times the photo's exposure, and look that way
mostly from that camera (a lobe in the harmonics of degree 1)."""

import numpy as np

from .geometry import *


def make(ply_path, cameras_json_path, count, seed):
    rng = np.random.default_rng([seed, 0xB])
    sc = Scene(ply_path, cameras_json_path)
    S = sc.S
    ns, nc, nn, nv = counts(count)
    w = 1.0 / np.arange(1, sc.n + 1) ** 1.1  # Zipf: a handful of guilty photos
    w = rng.permutation(w / w.sum())
    gain = np.exp(
        rng.normal(0, 0.22, (sc.n, 1)) + rng.normal(0, 0.05, (sc.n, 3))
    )  # exposure and white balance

    def rays(tlo, thi, least=2, lonely=0.08, edge=1.0, N=600, cam=None, agree=0.25):
        """Places on camera rays: share t of the depth behind, log-uniform. `lonely`: accepted with one view only."""

        def draw():
            k = rng.choice(sc.n, p=w) if cam is None else cam
            u01 = rng.beta(edge, edge, (N, 2))  # edge < 1: towards the picture's borders
            u, v = u01[:, 0] * sc.W[k], u01[:, 1] * sc.H[k]
            D, col = sc.behind(k, u, v)
            z = np.minimum(D, 3 * S) * np.exp(rng.uniform(np.log(tlo), np.log(thi), N))
            z = np.maximum(z, 0.06 * S)
            X = sc.unproject(k, u, v, z)
            ok = sc.free(X, least, 0.93, near=0.04, agree=agree)
            few = sc.free(X, 1, 0.93, near=0.04, agree=0.2)
            keep = ok | (few & (rng.random(N) < lonely))
            i = np.flatnonzero(keep)[: max(4, N // 40)]  # a few per draw: several cameras take part
            return X[i], z[i], np.full(len(i), k), col[i]

        return draw

    def photo_colour(k, dc):
        rgb = np.clip((0.5 + C0 * dc), 0.02, 1.2) * gain[k]
        return (np.clip(rgb, 0, 1.1) - 0.5) / C0 + rng.normal(0, 0.08, dc.shape)

    def lobe(X, k, s=0.1):
        """Degree 1 turned to camera k (brighter or darker from there), the rest noise."""
        if not sc.nrest:
            return None
        K = sc.nrest // 3
        d = X - sc.C[k]
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        basis = np.stack([-d[:, 1], d[:, 2], -d[:, 0]], 1)
        amp = np.abs(rng.normal(0, s, len(X)))[:, None] * np.sign(gain[k] - 1)
        r = rng.normal(0, 0.015, (len(X), 3, K))
        r[:, :, :3] += amp[:, :, None] * basis[:, None, :]
        return r.reshape(len(X), -1)

    def px(k, z, pixels):  # size on that photo, in thousandths of its width
        return pixels / 1000 * sc.W[k] / sc.fx[k] * z

    parts = []
    X, z, k, col = gather(ns, rays(0.08, 0.6, edge=0.7))
    b = px(k, z, np.exp(rng.normal(np.log(7), 0.6, ns)))
    sca = np.stack(
        [b * np.exp(rng.normal(0.7, 0.4, ns)), b, b * np.exp(rng.normal(0, 0.3, ns))], 1
    )  # longer along the ray
    al = 1 - np.exp(-rng.gamma(1.3, 0.28, ns)) + 0.01
    parts.append(
        (
            sc.rows(X, al, sca, quat_along(rng, X - sc.C[k]), photo_colour(k, col), lobe(X, k)),
            "single",
        )
    )

    nb = int(min(max(1, nc // 5), 10))
    size = sizes_of(rng, nc, nb)
    G = []
    for m in size:  # plugs: a patch of one photo at one depth
        if not m:
            continue
        for _ in range(200):
            c0, z0, k0, _c = (a[:1] for a in gather(1, rays(0.15, 0.6, 3, 0, N=200)))
            kk = int(k0[0])
            uu, vv, _ = sc.project(kk, c0)
            wpx = sc.W[kk] * rng.uniform(0.02, 0.06)

            def draw():
                u = uu + rng.uniform(-1, 1, 300) * wpx
                v = vv + rng.uniform(-1, 1, 300) * wpx * rng.uniform(0.5, 1)
                zz = z0 * (1 + rng.normal(0, 0.025, 300))
                Y = sc.unproject(kk, u, v, zz)
                g = sc.free(Y, 2, 0.95, 0.04, 0.2)
                _, cc = sc.behind(kk, u, v)
                return (
                    Y[g],
                    zz[g],
                    np.full(g.sum(), kk),
                    cc[g],
                    np.full(g.sum(), wpx / sc.fx[kk] * z0[0]),
                )

            try:
                G.append(gather(m, draw, 20))
                break
            except RuntimeError:
                continue
    X, z, k, col, rad = (np.concatenate([g[i] for g in G]) for i in range(5))
    m = len(X)
    b = rad * np.exp(rng.normal(np.log(0.2), 0.35, m))
    sca = np.stack([b * np.exp(rng.normal(-0.3, 0.5, m)), b, b * np.exp(rng.normal(0, 0.3, m))], 1)
    parts.append(
        (
            sc.rows(
                X,
                rng.beta(2, 3, m),
                sca,
                quat_along(rng, X - sc.C[k]),
                photo_colour(k, col),
                lobe(X, k, 0.07),
            ),
            "cluster",
        )
    )

    X, z, k, col = gather(
        nn, rays(0.08, 0.55, edge=0.8)
    )  # needles that point at the lens, one in five athwart
    d = (X - sc.C[k]) / np.linalg.norm(X - sc.C[k], axis=1, keepdims=True)
    d = d + rng.normal(0, 0.06, d.shape)
    ath = rng.random(nn) < 0.2
    d[ath] = rng.normal(size=(ath.sum(), 3))
    thin = px(k, z, np.exp(rng.normal(np.log(2.2), 0.45, nn)))
    L = np.minimum(thin * np.exp(rng.uniform(np.log(7), np.log(45), nn)), 0.45 * z)
    sca = np.stack([L, thin, thin * np.exp(rng.normal(0, 0.25, nn))], 1)
    sca[:, 1:] = np.minimum(sca[:, 1:], L[:, None] / 6)
    parts.append(
        (
            sc.rows(
                X,
                rng.beta(1.6, 2.4, nn) * 0.9 + 0.03,
                sca,
                quat_along(rng, d),
                photo_colour(k, col),
                lobe(X, k),
            ),
            "needle",
        )
    )

    X, z, k, col = gather(
        nv, rays(0.12, 0.45, 2, 0.05, edge=1.5)
    )  # veils before the lens: the exposure made matter
    L = px(k, z, rng.uniform(100, 260, nv))
    sca = np.stack([L * rng.uniform(0.03, 0.2, nv), L, L * rng.uniform(0.5, 1, nv)], 1)
    veil = (np.where(gain[k] > 1, 0.9, 0.08) + rng.normal(0, 0.05, (nv, 3)) - 0.5) / C0
    parts.append(
        (
            sc.rows(
                X,
                rng.uniform(0.015, 0.1, nv),
                sca,
                quat_along(rng, X - sc.C[k]),
                0.6 * veil + 0.4 * col,
                lobe(X, k, 0.05),
            ),
            "veil",
        )
    )
    return finish(rng, parts)
