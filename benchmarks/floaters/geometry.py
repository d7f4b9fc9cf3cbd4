"""Geometry shared by the three recipes: reading, coarse depth, free-space test. No recipe choices here."""

import json

import numpy as np
from plyfile import PlyData

C0 = 0.28209479177387814


class Scene:
    def __init__(self, ply_path, cameras_json_path, cell_px_frac=1 / 48):
        v = PlyData.read(ply_path)["vertex"].data
        self.v, self.dtype = v, v.dtype
        self.xyz = np.stack([v["x"], v["y"], v["z"]], 1).astype(np.float64)
        self.op = 1 / (1 + np.exp(-np.clip(np.asarray(v["opacity"], np.float64), -30, 30)))
        self.logs = np.stack([v[f"scale_{i}"] for i in range(3)], 1).astype(np.float64)
        self.dc = np.stack([v[f"f_dc_{i}"] for i in range(3)], 1).astype(np.float64)
        ok = np.isfinite(self.xyz).all(1) & np.isfinite(self.logs).all(1) & np.isfinite(self.op)
        self.ok = ok
        self.nrest = sum(n.startswith("f_rest_") for n in v.dtype.names)
        cs = json.load(open(cameras_json_path))
        self.C = np.array([c["position"] for c in cs], float)
        self.R = np.array([c["rotation"] for c in cs], float)  # camera to world
        self.W = np.array([c["width"] for c in cs], float)
        self.H = np.array([c["height"] for c in cs], float)
        self.fx = np.array([c["fx"] for c in cs], float)
        self.fy = np.array([c["fy"] for c in cs], float)
        self.n = len(cs)
        self.up = -self.R[:, :, 1].mean(0)
        self.up /= np.linalg.norm(self.up) + 1e-12
        self._depth(cell_px_frac)

    # ---- projection
    def project(self, k, X):
        p = (X - self.C[k]) @ self.R[k]
        z = p[:, 2]
        zs = np.where(np.abs(z) < 1e-9, 1e-9, z)
        return (
            p[:, 0] / zs * self.fx[k] + self.W[k] / 2,
            p[:, 1] / zs * self.fy[k] + self.H[k] / 2,
            z,
        )

    def unproject(self, k, u, v, z):
        q = np.stack(
            [(u - self.W[k] / 2) / self.fx[k] * z, (v - self.H[k] / 2) / self.fy[k] * z, z], -1
        )
        return q @ self.R[k].T + self.C[k]

    # ---- coarse depth: per cell, the depth at which accumulated optical weight of the splats passes a half
    def _depth(self, frac):
        self.gw = np.maximum(8, np.ceil(np.ones(self.n) / frac)).astype(int)
        self.gh = np.maximum(6, np.round(self.gw * self.H / self.W)).astype(int)
        use = self.ok & (self.op > 0.05)
        X, op = self.xyz[use], self.op[use]
        s = np.sort(np.exp(np.clip(self.logs[use], -20, 5)), 1)
        area = 2 * np.pi * s[:, 2] * s[:, 1]
        self.D, self.CELLC = [], []
        dcv = self.dc[use]
        meds = []
        for k in range(self.n):
            gw, gh = self.gw[k], self.gh[k]
            u, v, z = self.project(k, X)
            m = (z > 1e-3) & (u >= 0) & (u < self.W[k]) & (v >= 0) & (v < self.H[k])
            D = np.full(gw * gh, np.inf)
            col = np.zeros((gw * gh, 3))
            if m.any():
                cid = (v[m] / self.H[k] * gh).astype(int) * gw + (u[m] / self.W[k] * gw).astype(int)
                zz = z[m]
                cell = self.W[k] * self.H[k] / (gw * gh)
                w = op[m] * np.minimum(area[m] * self.fx[k] * self.fy[k] / zz**2 / cell, 1.0) + 1e-9
                o = np.lexsort((zz, cid))
                cid, zz, w, dd = cid[o], zz[o], w[o], dcv[m][o]
                cum = np.cumsum(w)
                start = np.r_[0, np.flatnonzero(np.diff(cid)) + 1]
                base = np.r_[0, cum[start[1:] - 1]]
                rep = np.diff(np.r_[start, len(cid)])
                loc = cum - np.repeat(base, rep)
                tot = np.r_[cum[start[1:] - 1], cum[-1]] - base
                hit = loc >= np.repeat(np.minimum(0.5, 0.5 * tot), rep) - 1e-12
                idx = np.flatnonzero(hit)
                first = np.unique(cid[idx], return_index=True)
                D[first[0]] = zz[idx[first[1]]]
                col[first[0]] = dd[idx[first[1]]]
                meds.append(np.median(D[np.isfinite(D)]))
            self.D.append(D.reshape(gh, gw))
            self.CELLC.append(col.reshape(gh, gw, 3))
        self.S = float(np.median(meds))  # the scene's size: median viewing depth
        for k in range(self.n):  # sky and holes: as far as the far tenth
            D = self.D[k]
            f = np.isfinite(D)
            far = np.percentile(D[f], 90) if f.any() else self.S
            self.CELLC[k][~f] = self.CELLC[k][f].mean(0) if f.any() else 0
            self.sky = getattr(self, "sky", 0) + (~f).sum()
            D[~f] = far
        for k in range(self.n):  # nearest of the 3 x 3 cells: silhouettes are safe
            D = self.D[k]
            P = np.pad(D, 1, mode="edge")
            self.D[k] = np.min(
                [P[i : i + D.shape[0], j : j + D.shape[1]] for i in range(3) for j in range(3)], 0
            )
        self.vox = self.S * 0.025
        solid = self.ok & (self.op > 0.1)
        self.occ = np.unique(self._key(self.xyz[solid]))

    def _key(self, X):
        q = np.clip(np.floor(X / self.vox), -(2**19), 2**19).astype(np.int64) + 2**20
        return (q[:, 0] << 42) | (q[:, 1] << 21) | q[:, 2]

    def behind(self, k, u, v):
        """(depth, DC) of what camera k sees at pixel u, v."""
        i = np.clip((v / self.H[k] * self.gh[k]).astype(int), 0, self.gh[k] - 1)
        j = np.clip((u / self.W[k] * self.gw[k]).astype(int), 0, self.gw[k] - 1)
        return self.D[k][i, j], self.CELLC[k][i, j]

    def seen(self, X, margin=0.9, near=0.03):
        """Number of cameras with X inside the image; number of those in front of whose surfaces X lies."""
        ins = np.zeros(len(X), int)
        front = np.zeros(len(X), int)
        for k in range(self.n):
            u, v, z = self.project(k, X)
            m = (z > near * self.S) & (u >= 0) & (u < self.W[k]) & (v >= 0) & (v < self.H[k])
            ins += m
            i = np.flatnonzero(m)
            if len(i):
                d, _ = self.behind(k, u[i], v[i])
                front[i] += z[i] < margin * d
        return ins, front

    def free(self, X, least=2, margin=0.9, near=0.03, agree=0.3, occupied=True):
        """Free space: in front of what `least` cameras see, of a share `agree` of those that have it in the image,
        in no voxel that holds a splat, and on no camera."""
        ins, front = self.seen(X, margin, near)
        r = (front >= least) & (front >= agree * ins)
        if occupied:
            r &= ~np.isin(self._key(X), self.occ)
        for c in self.C:
            r &= ((X - c) ** 2).sum(1) > (near * self.S) ** 2
        return r

    # ---- rows
    def rows(self, xyz, alpha, scales, quats, dc, rest=None):
        out = np.zeros(len(xyz), self.dtype)
        for i, a in enumerate("xyz"):
            out[a] = xyz[:, i]
        a = np.clip(alpha, 0.006, 0.995)
        out["opacity"] = np.log(a / (1 - a))
        q = quats / np.linalg.norm(quats, axis=1, keepdims=True)
        for i in range(3):
            out[f"scale_{i}"] = np.log(np.maximum(scales[:, i], 1e-7 * self.S))
            out[f"f_dc_{i}"] = dc[:, i]
        for i in range(4):
            out[f"rot_{i}"] = q[:, i]
        if rest is not None and self.nrest:
            for i in range(self.nrest):
                out[f"f_rest_{i}"] = rest[:, i]
        return out

    def rest_raw(self, idx):
        if not self.nrest:
            return np.zeros((len(idx), 0))
        return np.stack([self.v[f"f_rest_{i}"][idx] for i in range(self.nrest)], 1).astype(float)


def rand_quat(rng, n):
    q = rng.normal(size=(n, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def quat_from_axes(M):
    """Rotation matrices (columns: the splat's axes in the world) to quaternions w, x, y, z."""
    m = M
    q = np.empty((len(m), 4))
    q[:, 0] = 1 + m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    q[:, 1] = 1 + m[:, 0, 0] - m[:, 1, 1] - m[:, 2, 2]
    q[:, 2] = 1 - m[:, 0, 0] + m[:, 1, 1] - m[:, 2, 2]
    q[:, 3] = 1 - m[:, 0, 0] - m[:, 1, 1] + m[:, 2, 2]
    q = np.sqrt(np.maximum(q, 0)) / 2
    b = q.argmax(1)
    d = np.stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], 1)
    s = np.stack([m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]], 1)
    o = np.empty_like(q)
    for i in range(len(m)):
        x, y, z, w = q[i, 1], q[i, 2], q[i, 3], q[i, 0]
        if b[i] == 0:
            o[i] = [w, *(d[i] / (4 * w))]
        elif b[i] == 1:
            o[i] = [d[i, 0] / (4 * x), x, s[i, 0] / (4 * x), s[i, 1] / (4 * x)]
        elif b[i] == 2:
            o[i] = [d[i, 1] / (4 * y), s[i, 0] / (4 * y), y, s[i, 2] / (4 * y)]
        else:
            o[i] = [d[i, 2] / (4 * z), s[i, 1] / (4 * z), s[i, 2] / (4 * z), z]
    return o / np.linalg.norm(o, axis=1, keepdims=True)


def quat_along(rng, d):
    """Quaternions whose first axis is d, the roll by chance."""
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    h = rng.normal(size=d.shape)
    y = np.cross(d, h)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    return quat_from_axes(np.stack([d, y, np.cross(d, y)], 2))


def counts(count):
    nc, nn, nv = round(0.25 * count), round(0.26 * count), round(0.04 * count)
    return count - nc - nn - nv, nc, nn, nv


def finish(rng, parts):
    """parts: list of (rows, kind). Joined and shuffled, so the place in the array tells nothing."""
    r = np.concatenate([p[0] for p in parts])
    k = np.concatenate([np.full(len(p[0]), p[1], "<U7") for p in parts])
    o = rng.permutation(len(r))
    return r[o], k[o]


def gather(need, draw, tries=400):
    """Calls draw() -> tuple of equally long arrays (accepted ones only) until there are `need`."""
    got, n = [], 0
    for _ in range(tries):
        if n >= need:
            break
        g = draw()
        if len(g[0]):
            got.append(g)
            n += len(g[0])
    if n < need:
        raise RuntimeError(f"only {n} of {need} places found in free space")
    return tuple(np.concatenate([g[i] for g in got])[:need] for i in range(len(got[0])))


def sizes_of(rng, n, k, conc=2.0):
    p = rng.dirichlet(np.full(k, conc))
    return rng.multinomial(n, p)
