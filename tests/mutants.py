"""Deliberate faults in core and in what views draw, to be caught by its tests: ``make mutants``.

    python tests/mutants.py [module ...]

Every mutant is a copy of the project with one line changed. Prints which tests caught it, and fails
if one survives, or if the line to change is no longer there.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

PROJECT = Path(__file__).resolve().parent.parent

MUTANTS = {
    "../viewport/arrays.py": [
        ("keys = ((high - values) * scale)", "keys = ((values - low) * scale)", "nearest first"),
        (
            "away = means - eye.place.astype(np.float32)",
            "away = eye.place - means",
            "seen from behind",
        ),
        ("(depths > near) &", "(depths > 0.0) &", "near plane ignored"),
        (
            "axes @ axes.transpose(0, 2, 1)",
            "axes.transpose(0, 2, 1) @ axes",
            "turned the other way",
        ),
    ],
    "whole_file.py": [
        ("            checkpoint()  #", "            #", "cancelled, and there all the same"),
    ],
    "pace.py": [
        ("passed * (total - done) / done", "passed * total / done", "time in all, not left"),
        ("not 0.0 < done < total", "not 0.0 <= done < total", "a pace before anything is done"),
    ],
    "processes.py": [
        ("work(begin + piece.start)", "work(piece.start)", "what is left begins anew"),
        ("                begin += 1\n", "", "what was done is done again"),
        ("            _tell_all(team, None)\n", "", "work kept"),
        (
            "progress=progress, what=what, threads=number, stop=stop",
            "progress=progress, what=what, threads=number",
            "processes go on",
        ),
    ],
    "work.py": [
        ("            cancelled.set()\n", "", "what runs is not told"),
        ("time.monotonic() - told >= _REPORT_INTERVAL", "False", "one thread not asked"),
    ],
    "solid.py": [
        ("below = y[corners] <= py[:, None]", "below = y[corners] < py[:, None]", "ends twice"),
        (
            "first, last = np.minimum(one, other), np.maximum(one, other)",
            "first, last = one, other",
            "edges cut otherwise by each side",
        ),
        ("above = heights > points[rows, 2]", "above = heights >= points[rows, 2]", "upper face"),
        ("turns != 0.0 if self.turned", "turns == 1.0 if self.turned", "overlaps left out"),
        ("wide = (np.floor", "wide = False & (np.floor", "wide triangles touch few cells"),
    ],
    "volumes.py": [
        ("removed = removed & ~protected", "pass", "force wins over protection"),
        ("removed | ~masks", "removed & ~masks", "removed only where not kept"),
        ("points < self.high", "points <= self.high", "boxes share their faces"),
    ],
    "task.py": [
        ("removed = removed & ~self.protected", "pass", "force wins over protection"),
        ("rows[rest] if isinstance", "rows if isinstance", "rows of all"),
        ("self.budget.after(int(np.count_nonzero(forced)), len(forced))", "self.budget", "twice"),
    ],
    "seeing/frustum.py": [
        ("-view.rotation @ center", "view.rotation @ center", "sign of translation"),
        ("depth[:count] >= self._near[views[:count]]", "depth[:count] >= 0.0", "no near plane"),
        ("(outside < reach * self.steepness)", "(outside <= 0.0)", "what reaches inside left out"),
        ("(np.maximum.reduce(most[:4]) <= 0.0)", "(outside <= 0.0)", "a corner inside is all"),
        ("& (least[4] >= near) & (most[4] <= far)", "", "all inside before the near plane"),
        ("between & (beyond <= 0.0)", "between", "counted beside the image"),
        (
            "between &= depth[:count] <= self",
            "between &= depth[:count] < self",
            "far plane excluded",
        ),
        ("np.hypot(1.0, slope)", "slope", "reach along the image only"),
        ("view.cx - view.width / 2", "view.width / 2 - view.cx", "shift mirrored"),
        ("view.height / 2)", "view.width / 2)", "axes swapped"),
        ("<= side.half * z", "<= side.half", "image of another depth"),
        ("(z >= planes[0]) &", "(z > planes[0]) &", "near plane excluded"),
    ],
    "radix.py": [
        ("(values + values.dtype.type(0.0))", "values", "-0 before 0"),
        ("keys[undefined] = ~unsigned(0)", "keys[undefined] = unsigned(0)", "NaN is the lowest"),
        ("ranks = [(total - 1) // 2,", "ranks = [total // 2,", "upper median"),
        ('side="right"', 'side="left"', "off by one"),
    ],
    "tiles/units.py": [
        ("room -= stop - start", "room = room", "units beyond their rows"),
        ("begin + start, begin + stop", "start, stop", "rows of another place of the tile"),
        ("[*kinds.values()] if len(kinds) > 1 else []", "[]", "types of a few rows"),
        ("tile.begin + part.start", "tile.begin + 0 * part.start", "always the first rows"),
        ("!= (tile.size, tile.changed)", "[0] != tile.size", "time not compared"),
    ],
    "tiles/steps.py": [
        (
            'found["values"] < np.float32(rule.threshold)',
            'found["values"] <= np.float32(rule.threshold)',
            "threshold goes",
        ),
        ("rule.left[unit.index]", "rule.left[0]", "ties of the first unit"),
        ("if part.tile == tile:", "if True:", "rows of other tiles"),
    ],
    "tiles/storage.py": [
        ("if not any(word in name", 'if name == "size" and not any(word in name', "only the size"),
        ("begin + count * dtype.itemsize)", "begin + count)", "ranges of too few bytes"),
        ("stream.seek(max(whole - 1, 0))", "stream.seek(0)", "whole files sent for each range"),
        ('if not name.startswith("file://"):', "if True:", "tiles replaced by another name"),
        ("if not overwrite and system.exists(inner):", "if False:", "replaced unasked"),
        ("Interrupted if isinstance(path, Url) else RefineError", "RefineError", "all lost"),
    ],
    "urls.py": [
        ("[A-Za-z0-9+.:-]+://", "[A-Za-z0-9+.:-]*://", "drives of Windows as URLs"),
        ("isinstance(text, str) and _URL", "False and _URL", "URLs as paths"),
    ],
    "tiles/folder.py": [
        ("        self.note(name, found)\n", "", "nothing is done for good"),
        ("result or ()]", "()]", "results forgotten"),
        ("fcntl.LOCK_EX | fcntl.LOCK_NB", "fcntl.LOCK_SH | fcntl.LOCK_NB", "two runs at once"),
    ],
    "tiles/prune.py": [
        ("(amount - below - before)", "(amount - below - 0 * before)", "ties in each unit"),
        ("except Exception:\n            job.folder.remove()", "except Exception:", "leavings"),
        ("kept * tile.row_bytes)", "kept * tile.row_bytes + shorter)", "size of another header"),
        ("if identity(target) in read:", "if False:", "tiles replaced while read"),
        ("if target in targets[:place]:", "if False:", "one output for two tiles"),
    ],
    "tiles/seen.py": [
        ("index=some.index + number * CHUNK", "index=some.index", "rows of the first chunk"),
        (
            "np.concatenate(colors)[at]",
            "np.concatenate(colors)",
            "colours in the order of the curve",
        ),
        (
            "at = np.searchsorted(rows, footprints.index)",
            "at = np.argsort(footprints.index)",
            "colours of others",
        ),
        (
            "        if self.folder.has(name):\n            return\n        sample",
            "        sample",
            "measured again",
        ),
    ],
    "tiles/scoring.py": [
        (
            "rows = slice(start, start + len(unit))",
            "rows = slice(0, len(unit))",
            "scores of others",
        ),
    ],
    "tiles/absorbing.py": [
        ("others * expected.error", "0.0 * expected.error", "the other views forgotten"),
        ("_ASKEW if stage % 2 else", "_ASKEW if stage < 0 else", "the same planes in each stage"),
        ("mine + self.starts[number]", "mine", "rows of the first source"),
        ('own["stood"][stands], len(left)', "None, len(left)", "members forgotten"),
        ("(k, whole), n / total", "(k, 0.0 * whole), n / total", "no allowance in any region"),
        ("weights[order[last + 1 :]] = 0.0", "weights[:] = 1.0", "the same share of each region"),
    ],
    "scoring/closed_form_block.py": [
        (
            "visibility *= self.alpha[piece]",
            "visibility *= self.alpha[piece] ** 2",
            "opacity twice",
        ),
        ("self.count([0], HIGHEST)", "self.count([0], 0)", "another digit counted first"),
        ("LUMA = (0.299, 0.587, 0.114)", "LUMA = (0.114, 0.587, 0.299)", "BGR"),
        ("largest + middle", "largest + smallest", "wrong two scales"),
        ("share = 1.0 - away", "share = 1.0 - 0.0 * away", "all that reaches inside counts whole"),
        ("depth.ravel()[index] + away", "depth.ravel()[index]", "depth beside the camera"),
        ("between > inside", "beyond > 0.0", "planes forgotten outside the image"),
        (
            "weight * powers[self.cells[piece]]",
            "powers[self.cells[piece]]",
            "neighbours count from the first",
        ),
    ],
    "scoring/nearness.py": [
        ("axes[2] ^= axes[1]", "", "no Hilbert curve"),
        ("    return np.argsort(_places()[cell]", "    return np.argsort(cell", "cells in slices"),
        ("dtype=np.float64)  # (N,)", "dtype=values.dtype)", "positions beyond float32"),
    ],
    "scoring/adaptive.py": [
        ("math.log(geometry)", "math.log(1 + geometry)", "wrong logarithm"),
    ],
    "seeing/sight_lines.py": [
        ("front = through - self.dark", "front = through", "a splat hides itself"),
        ("    front -= before\n", "", "a splat hides itself from ranking"),
        ("lost /= after", "lost *= after", "the colour behind is not laid open"),
        (
            "pixels(view, number + len(views), count)",
            "pixels(view, number, count)",
            "judged by what ranks",
        ),
        ("max(len(views), FEW)", "len(views)", "one view notes all"),
        (" - 5.0 / math.log(10.0) * relative", "", "chance not mended"),
        ("np.where(back < on, before, after)", "after", "only those behind take over"),
        ('order[np.argsort(protected[order], kind="stable")]', "order", "protection forgotten"),
        ("weights @ values / weights.sum()", "values.mean(axis=0)", "views count alike"),
    ],
    "scoring/removal_rounds.py": [
        ("weight * view.width", "view.width", "weight of views forgotten"),
        (".keeping(keep)\n            with", "\n            with", "what has gone hides"),
        ("(met * now[0] + KNOWN * error)", "(met * now[0] + KNOWN * own[0])", "no growth"),
        ("before + prior", "before + 1.0", "growth of few lines believed"),
    ],
    "estimate/alignment.py": [
        (" or there >= WHOLE * count", "", "rings around all are judged"),
        ("spans.max() < SMALL", "spans.min() < SMALL", "what is thin is far"),
        ("            if view.weight:", "            if True:", "views of weight 0 are far"),
        ("weight / (1.0 + square[lines.met[owner]])", "weight", "blobs are fine"),
    ],
    "selection.py": [
        ("ties[: max(left, 0)]", "ties[-left:]", "ties from the end"),
        ("[amount - 1])[0]", "[amount])[0]", "off by one"),
        ("else free\n    keys", "else slice(None)\n    keys", "protection forgotten"),
        ("np.cumsum(each) - each < left", "np.cumsum(each) < left", "a row of text too many"),
        ("Fraction(repr(float(self.ratio)))", "self.ratio", "binary ratio"),
        ("count = min(count or 0, len(self._values))", "count = count or 0", "protected counted"),
        ("self._seen = np.sort(scores.seen[free])", "self._seen = scores.seen", "not in order"),
    ],
    "splats.py": [
        ("w, x, y, z = np", "x, y, z, w = np", "quaternion order"),
        ("good &= (largest <= _LOG_LARGEST)", "good &= (largest <= 1e9)", "huge drawn"),
        ("SINGLE_MARGIN = 2.0**-26", "SINGLE_MARGIN = 1e-7", "float32 of 1 is told from 1"),
        ("LOG_ZERO = -104.0", "LOG_ZERO = -103.0", "what is 0 is drawn"),
        ("sizes = np.abs(", "sizes = (", "sign of a scale"),
        ("off = finite & other", "off = finite", "unit quaternions lose bits"),
    ],
    "spherical_harmonics.py": [
        ("points @ rotation, degree", "points @ rotation.T, degree", "inverse"),
        ("found += np.einsum", "found -= np.einsum", "sign of harmonics"),
    ],
    "affine.py": [
        ("> 0 else -rotation", "> 0 else rotation", "mirror not undone"),
    ],
    "views.py": [
        ("key=lambda index: self.views[index].name", "key=lambda index: index", "ties by index"),
        (
            "reach = _median(distance, weights)",
            "reach = distance.max()",
            "as exact as the farthest",
        ),
        (
            "np.searchsorted(np.cumsum(weights[order]), 0.5 - 1e-9)",
            "len(order) // 2",
            "median without weights",
        ),
        ("rotation @ rotation.T, center=", "rotation @ rotation, center=", "turned back"),
    ],
    "formats/compressed_ply.py": [
        (
            "low * (1.0 - share) + high * share",
            "low * share + high * (1.0 - share)",
            "reversed",
        ),
        (
            "(np.arange(1, 255) + 0.5) / 256.0",
            "np.arange(1, 255) / 256.0",
            "codes at an end",
        ),
        ("len(chunks) < needed", "len(chunks) < needed - 1", "a chunk too few is read"),
        ("np.minimum.reduceat(values", "np.maximum.reduceat(values", "no range"),
    ],
    "formats/dot_splat.py": [
        ("= scales(some.log_scales)", "= some.log_scales", "log scales stored"),
        ("    if beyond:", "    if beyond > 31:", "a cut splat is no fault"),
    ],
    "formats/format.py": [
        ("np.where(negative, -others, others)", "others", "sign of the largest component"),
        ("np.rint(np.clip(shares, 0.0, 1.0) * largest)", "shares * largest", "codes not rounded"),
        ("    if needed > available:", "    if needed > available + 8:", "a few bytes too few"),
    ],
    "formats/glb.py": [
        ("np.stack([-z, -y, x, w], axis=1)", "np.stack([w, x, y, z], axis=1)", "rotations stay"),
        ("(-1.0) ** m for band", "(-1.0) ** band for band", "harmonics turned otherwise"),
        ("if count > len(data):", "if count > 100 * len(data):", "one mesh in many nodes"),
        ("above @ _matrix(document", "_matrix(document", "parents of nodes"),
    ],
    "formats/glb_document.py": [
        ("end > length or", "", "a value beyond its view"),
        ("step < size or", "", "values that overlap"),
        ("kind, data[at : at + size]", "kind, data[at:]", "chunks up to the end of the file"),
    ],
    "formats/registry.py": [
        ("        if not good.all():", "        if good.all():", "undrawable splats written"),
        ("math.ceil(sizes.row * count) + sizes.fixed", "sizes.fixed", "a size without splats"),
        (
            "values if keep is None else values[keep]",
            "values[: len(rows)]",
            "columns moved",
        ),
    ],
    "formats/sog.py": [
        ("np.expm1(np.abs(places))", "np.abs(places)", "positions left logarithmic"),
        ("pixels[:, 0] + 256 * pixels[:, 1]", "pixels[:, 0]", "labels of 8 bits"),
        ("across * down > 4 * count + (1 << 16)", "across * down > 1 << 40", "images of any size"),
        ("wider = spread > widest", "wider = spread < widest", "halved along the narrowest"),
    ],
    "formats/spz.py": [
        ("for size in (_STEP, 1):", "for size in (_STEP,):", "damage to a step alone"),
        (" and head.startswith(GZIP)", "", "any file by its name"),
        ("(whole << 8) >> 8", "whole", "positions without sign"),
        ("[:, _WXYZ]", "", "rotations x y z w"),
        (
            "            if len(found) > length:",
            "            if len(found) > length + (1 << 40):",
            "a stream without end",
        ),
        ("_INFLATION * len(data)", "1 << 62", "memory by a lying count"),
    ],
    "formats/ply_columns.py": [
        (
            "sh_rest = planes.transpose(0, 2, 1)",
            "sh_rest = planes.reshape(size, -1, 3)",
            "SH channel order",
        ),
    ],
    "formats/ply_write.py": [
        (
            "one.view(bits) != np.ascontiguousarray(other).view(bits)",
            "one.view(bits) == one.view(bits)",
            "every word of a text row rewritten",
        ),
        ("most - len(word)", "most - 1 - len(word)", "a longest line that is not"),
    ],
    "survivors.py": [
        (
            "columns[name] = stored[name].copy()",
            "columns[name] = stored[name].astype(np.float32)",
            "doubles rounded to floats",
        ),
        ("np.flatnonzero(absorbed.keep)[changed]", "changed", "survivors in other rows"),
    ],
    "cameras/colmap.py": [("if left:", "if left < 0:", "what is not announced skipped")],
    "scoring/occlusion.py": [
        ("stay > rest, stays", "stay >= rest, stays", "a round too many"),
        ("max(count - settled, 0)", "settled", "what stays taken for what goes"),
        (
            "LEAST ** (number / (rounds - 1))",
            "LEAST ** ((number - 1) / (rounds - 1))",
            "a round late",
        ),
        (
            'ClosedForm("distance", frustum=False, local=False)',
            'ClosedForm("distance")',
            "prior with a frustum",
        ),
        (
            'removal.add(undrawn[np.argsort(self.prior[undrawn], kind="stable")])',
            "removal.add(undrawn)",
            "hopeless in file order",
        ),
        ("        removal.values[self.undrawable] = 0.0\n", "", "undrawable not lowest"),
    ],
    "seeing/measuring.py": [
        (
            "number = self.numbers[place]",
            "number = self.numbers[0]",
            "the same view for all",
        ),
        (
            "self.contribution[seen.rows] += weight * seen.contribution",
            "self.contribution[seen.rows] += seen.contribution",
            "weight of views forgotten",
        ),
        ("seen.rows[seen.inside]", "seen.rows", "seen beside the image"),
        ("            seen *= seen\n", "", "transmittance not squared"),
    ],
    "seeing/froxels.py": [
        ("max(FEW_CELLS, len(", "min(MAX_CELLS, 9**9 + len(", "cells of 4 px whatever they cost"),
        (
            "    np.log(left, out=left)\n",
            "    np.subtract(left, np.float32(1.0), out=left)\n",
            "thickness of a thin point",
        ),
        (
            "np.minimum(footprints.alphas, np.float32(ALPHA_MAX), out",
            "np.maximum(footprints.alphas, 1.0, out",
            "covers more",
        ),
        ("    sums -= values\n", "", "a splat hides itself"),
        (
            "    sums -= np.repeat(sums.take(np.cumsum(columns) - columns), columns)\n",
            "",
            "one cell hides the next",
        ),
        (
            "np.asarray(np.repeat(sums.take(np.cumsum(columns) - 1), columns) - sums)",
            "sums",
            "colour in front for behind",
        ),
        ("number *= math.ceil(size[0])", "number *= math.ceil(size[0]) + 1", "rows too long"),
        ("total *= points.inside / np", "total *= 1.0 / np", "outside counts"),
        ("frame.axes[:, vast] = 0.0", "frame.axes[:, vast] += 0.0", "a sky beside is lost"),
        ("(high >= 0.0) & (low < size)\n", "(low >= 0.0) & (low < size)\n", "left edge lost"),
        ("            shares[again] = 0.0\n", "", "points merged twice"),
        (
            "_points_needed(footprints, side, density) > limit",
            "side > MAX_POINTS",
            "memory without bound",
        ),
        ("np.maximum(front - even, np.float32(0.0))", "front", "even cover counted twice"),
        (
            "narrow / (narrow + np.float32(area))",
            "np.float32(area) / (narrow + np.float32(area))",
            "a dot covers evenly",
        ),
    ],
    "seeing/projection.py": [
        ("(r[a, j] * r[b, i] if i != j else 0.0)", "0.0", "covariance off the diagonal"),
        (
            "(across * shape[5] - 2 * shape[2])",
            "(across * shape[5] + 2 * shape[2])",
            "sign in the Jacobian across",
        ),
        ("max(near / scene.size, 1e-5)", "max(near, 1e-5)", "near plane in another unit"),
        ("(z >= planes[0]) & (z <= planes[1])", "(z >= planes[0])", "far plane ignored"),
        (
            "np.abs(side.focal * coordinate + side.offset * z) <=",
            "np.abs(side.focal * coordinate - side.offset * z) <=",
            "principal point mirrored",
        ),
        (
            "-view.cx / view.fx - beyond[0], (view.width - view.cx) / view.fx + beyond[0]",
            "-(view.width - view.cx) / view.fx - beyond[0], view.cx / view.fx + beyond[0]",
            "clip mirrored across",
        ),
        ("np.asarray(order[second])", "np.asarray(second)", "half of the depth's bits"),
        ("opacity(logits) > ALPHA_CUT", "opacity(logits) > 0.0", "fainter than any renderer draws"),
        (
            "s = np.where(wide | (xy >= 0.0), s, -s)",
            "s = np.where(wide, s, s)",
            "tilt of upright ellipses",
        ),
        (
            "np.maximum(mean + root, 0.0) + LOW_PASS)",
            "np.maximum(mean + root, 0.0))",
            "low-pass forgotten",
        ),
        (
            "reach = _reach(side) * largest",
            "reach = 0.0 * largest",
            "size forgotten at the edge",
        ),
        ("known and away <=", "known or away <=", "farther than float32 holds"),
    ],
    "scoring/coverage.py": [
        ("(logs / math.log(10.0), DOUBTS)", "(logs, DOUBTS) * 0", "any floor that gains a hair"),
        ("/ (1.0 + seen)", "/ 1.0", "seen forgotten in floor"),
        ("max(pair) for pair", "pair[0] for pair", "no floor where views agree"),
        (
            "(scores[:, None] <= last)",
            "(scores[:, None] >= last)",
            "best go first",
        ),
        ("return [1.0] * len(SHARES)", "return [0.0] * len(SHARES)", "trust in what nobody judges"),
        ("table.min(axis=0) - table", "table - table.max(axis=0)", "the worst weight"),
    ],
    "absorbing/absorb.py": [
        ("members[taken >= 0]", "1 + 0 * taken[taken >= 0]", "members of the last stage alone"),
        ("(1.0 - share) / share)", "share / (1.0 - share))", "patience upside down"),
        (
            "share[gone] = share[into] * (1.0 - kept_share)",
            "share[gone] = share[into] * kept_share",
            "shares of harmonics swapped",
        ),
        ("reversed(graph.merges)", "graph.merges", "merges followed forwards"),
        (
            "np.flatnonzero(drawable(splats) & ~protected)",
            "np.flatnonzero(drawable(splats))",
            "unprotected",
        ),
        (
            "protected=spared[origin]",
            "protected=spared[: len(origin)]",
            "protection of another row",
        ),
        ("((stage + 1) / number))", "(stage / number))", "a stage late"),
        ("1 if share >= alone else", "", "half in two stages"),
        (
            "else math.ceil(math.log(share) / math.log(STAGE))",
            "else 1",
            "measured only once",
        ),
        (
            "np.log(opacity) - np.log1p(-opacity)",
            "np.log(opacity) + np.log1p(-opacity)",
            "sign in the logit",
        ),
    ],
    "absorbing/merge_field.py": [
        ("worth * second / (1.0 + self.seen)", "worth * second", "as likely after many views"),
        ("self.seen @ worth", "worth.sum()", "all seen once"),
        ("np.where(inside, counts, counts * BESIDE)", "counts", "views beside count"),
        (
            "np.where(inside, counts, counts * BESIDE) / squared",
            "np.where(inside, counts, counts * BESIDE)",
            "distance forgotten",
        ),
        (
            "np.sqrt(np.maximum(0.5 * (xx + yy) + half, 0.0))",
            "np.maximum(0.5 * (xx + yy) + half, 0.0)",
            "root of deviation forgotten",
        ),
    ],
    "absorbing/merging.py": [
        (
            "mass_1 + mass_2 - np.minimum(overlap, np.minimum(mass_1, mass_2))",
            "mass_1 + mass_2",
            "overlap counted twice",
        ),
        ("    between = position * other\n", "    between = position\n", "variance of the mixture"),
        ("covariances * pairs.growth[:, None]", "covariances", "growth forgotten"),
        (
            "one.means + (1.0 - position) * step",
            "one.means + position * step",
            "mean on the wrong side",
        ),
        (
            "one + two - ends.apart",
            "one + two + ends.apart",
            "sign of the colours",
        ),
        ("    both = np.clip(both, -limit, limit)\n", "", "contrasts beyond 1"),
        (
            "0.5 * _price(ends, -1.0).cost",
            "0.5 * _price(ends, 1.0).cost",
            "one side only",
        ),
        (
            "    direction[lost] = one.direction[lost]\n    return Field(",
            "    return Field(",
            "direction lost",
        ),
    ],
    "absorbing/merge_graph.py": [
        (
            "(cost == best[first]) & (cost == best[second])",
            "(cost == best[first]) | (cost == best[second])",
            "not each other's best",
        ),
        ("heir[gone] = into", "heir[gone] = gone", "heir forgotten"),
        (
            "field.contribution[second] > field.contribution[first]",
            "field.contribution[second] < field.contribution[first]",
            "the less seen survives",
        ),
        ("        self._price(mine[there], progress)\n", "", "costs not renewed"),
        ("self.cost[mine] = self.patience * cost", "self.cost[mine] = cost", "patience ignored"),
        ("count < self.connected / 2", "count < 0", "never connected anew"),
        ("self.alive & ~np.isnan(self.field.error)", "self.alive", "a round that does nothing"),
    ],
    "scoring/auto.py": [
        ("if loss <= tolerance:", "if loss < math.inf:", "tolerance ignored"),
        ("or not tolerance", "", "a tolerance of nothing forgotten"),
        (" / (1 / few - 1 / some)", "", "what is gained not carried on"),
        ("np.minimum(known[some], UNSEEN)", "known[some]", "gains that no eye sees"),
        ("if half[id(view)] else rest", "if True else rest", "the rest not left out"),
        ("(FIRST, FIRST + MORE,", "(FIRST, FIRST,", "an eighth not added"),
    ],
    "pictures.py": [
        ("near=near if near < far else view.near", "near=view.near", "near plane of each state"),
        ("through[line[first]] += behind[last] - before", "pass", "nothing hides what is behind"),
        (
            "front -= np.repeat(before - through[line[first]], last + 1 - first)",
            "front -= np.repeat(before, last + 1 - first)",
            "blocks of footprints side by side",
        ),
        ("cx=view.cx * across", "cx=view.cx", "principal point of the large image"),
    ],
    "png.py": [
        ("kind + data + struct.pack", "data + kind + struct.pack", "kind behind the data"),
        ("prepend=np.zeros((1, rows.shape[1]), np.uint8)", "prepend=rows[:1]", "first row black"),
    ],
    "picture_files.py": [
        ("refuse_existing(path, overwrite=self.overwrite)", "pass", "existing pictures replaced"),
        ("views.spread(CAMERAS)", "views.take(range(min(CAMERAS, len(views))))", "the first views"),
    ],
    "pipeline.py": [
        (
            "found.error + (1.0 - share) * expected.error",
            "found.error",
            "what the other views see forgotten",
        ),
        ("math.floor(FIRST * began)", "0", "merged from the first"),
        ("first = max(deleted - (began - total), 0)", "first = deleted", "a tenth of each level"),
        ("else protected[rest]", "else None", "protection forgotten"),
        (
            "keep[np.flatnonzero(rest)[absorbed.keep]] = True",
            "keep[np.flatnonzero(absorbed.keep)] = True",
            "survivors of other rows",
        ),
    ],
    "estimate/written.py": [
        (
            "if not np.array_equal(matrix, np.eye(4)):",
            "if False:",
            "the file's frame for the views'",
        ),
        ("if format_named(path) is None:", "if False:", "a plain PLY compared"),
    ],
    "estimate/quality.py": [
        (" - halvings * fewer", "", "few splats that gain as much"),
        ("if place >= gone", "if place > gone", "a share too many"),
    ],
    "report.py": [
        ("missing = made.left_out(keep)", "missing = 0", "splats that no file holds"),
        ("np.count_nonzero(seen == 0)", "np.count_nonzero(seen)", "unseen are seen"),
    ],
    "levels/lod.py": [
        ("        if not gone:\n            continue\n", "", "levels that are copies"),
        ("keep[first.keep] = second.keep", "keep[: len(second.keep)] = second.keep", "other rows"),
        (
            "first.changed[second.keep] | second.changed",
            "second.changed",
            "changed before forgotten",
        ),
        ("else scene.protected[whole.keep]", "else None", "protected in the first level alone"),
        ("origin=Origin(count, sights, psnr)", "origin=None", "each level a new original"),
    ],
    "levels/distance.py": [
        ("_width_of_most(splats, changed", "_width_of_most(splats, ~changed", "the unchanged"),
        ("<= OVERLOOKED * total:", "<= 0.0 * total:", "nothing is overlooked"),
        (".mean(axis=(2, 4))", "[:, :, 0, :, 0]", "one pixel for its square"),
        (
            "steps = [factor * self.distance",
            "steps = [self.distance / factor",
            "nearer, not farther",
        ),
    ],
    "levels/files.py": [
        (
            "    path.unlink(missing_ok=True)\n    return",
            "    return",
            "old manifest",
        ),
        ("_remove(set(before) - set(written), source)", "[]", "files of the run before"),
        ("if _LEVEL.fullmatch(name)]", "]", "any file that a manifest names"),
        ("            if path.samefile(source):", "            if False:", "the source itself"),
        ("                    path.unlink()\n", "                    pass\n", "levels left behind"),
    ],
    "scene.py": [
        ("np.where(first @ vectors < 0.0, -1.0, 1.0)", "1.0", "axes of either sign"),
        ("order[tied] = rows[np.lexsort((ties(rows), code[rows]))]", "pass", "ties by row"),
        ("+ views_squared", "", "views forgotten"),
    ],
    "cleaning/sight.py": [
        (
            "depth = depth + slope[owner] * along",
            "depth = depth + 0.0",
            "no slope",
        ),
        ("lines.dark * present", "lines.dark + 0.0 * present", "suspects hide what lies behind"),
        ("more = 1.0 / (1.0 - hits.alpha)", "more = 1.0", "a splat that dims its own support"),
        ("(stops + passes > SEEN * mass)", "(mass >= 0.0)", "views that see nothing"),
        ("stops < PAST * (stops + passes)", "stops < passes", "past by half"),
    ],
    "cleaning/clean.py": [
        ("(seen.views > 0) & ", "", "who sees nothing sees past"),
        ("masks[name] &= ~protected", "pass", "protected ones go"),
        ("sizes < SMALL", "sizes > SMALL", "clusters of any size"),
        ("self._floats(most) & shows", "self._floats(most)", "giants that do not show"),
        ("visible & doubted & ~needle", "visible & ~needle", "two reasons for one splat"),
        ("self.gaussians.alphas < VEIL, ", "False, ", "veils like other giants"),
        (" & agreed(self.evidence, effect)", "", "one view decides"),
        ("(seen.past >= AGREE * seen.views)", "True", "a minority of the views decides"),
        ("self.slender & (widest >= LONG) & ~giant", "self.slender & ~giant", "short needles"),
        ("(self.gaussians.largest >= HUGE) & (widest >= GIANT)", "widest >= GIANT", "near giants"),
        ("self.gaussians.alphas * contrast", "contrast", "opacity that does not count"),
        ("scales[:, 2] - scales[:, 1] >=", "scales[:, 2] - scales[:, 0] >=", "flakes as needles"),
        ("most | (some & (effect >= LOUD))", "most | some", "few views for what hardly shows"),
        ("(WIDE / np.maximum(widest, WIDE))", "1.0", "haze over the picture stays"),
    ],
    "cleaning/clusters.py": [
        ("* REACH", "* 0.0", "splats that never touch"),
    ],
    "absorbing/neighbours.py": [
        (
            "key[candidates == np.arange(piece.start, piece.stop)[:, None]] = _NOBODY",
            "",
            "a point its own neighbour",
        ),
        ("key[:, 1:][key[:, 1:] == key[:, :-1]] = _NOBODY", "", "the same neighbour twice"),
        ("points @ turns[curve].T + SHIFTS[curve]", "points", "all curves the same"),
        (
            "key |= candidates.astype(np.uint64)",
            "key |= candidates[::-1].astype(np.uint64)",
            "others",
        ),
    ],
}
"""Module of core -> lines to change, what they become, and what is wrong then."""

TESTS = {
    "closed_form": ["seeing/frustum.py", "scoring/adaptive.py", "scoring/closed_form_block.py"],
    "occlusion": [
        "seeing/measuring.py",
        "seeing/froxels.py",
        "seeing/projection.py",
        "scoring/coverage.py",
    ],
    "absorb": ["absorbing/merge_field.py", "absorbing/merging.py", "absorbing/merge_graph.py"],
    "cleaning": ["cleaning/clusters.py"],
    "cleaning_reasons": ["cleaning/sight.py", "cleaning/clean.py"],
    "command_pace": ["pace.py"],
    "invariance": ["scene.py"],
    "volumes": ["solid.py"],
    "forced": ["task.py"],
    "affine": ["spherical_harmonics.py"],
    "ply": ["formats/ply_columns.py", "formats/ply_write.py"],
    "formats": [
        "formats/dot_splat.py",
        "formats/format.py",
        "formats/registry.py",
    ],
    "glb": ["formats/glb_document.py"],
    "viewport_arrays": ["../viewport/arrays.py"],
    "command_counts": ["report.py"],
    "tiles": ["tiles/units.py", "tiles/steps.py", "tiles/folder.py", "tiles/prune.py"],
    "storage": ["tiles/storage.py", "urls.py"],
    "tiles_seen": ["tiles/seen.py", "tiles/scoring.py", "tiles/absorbing.py"],
    "levels": ["levels/lod.py", "levels/distance.py", "levels/files.py"],
    "pictures": ["png.py", "picture_files.py"],
}
"""Modules whose tests are not in the file of their own name; those run first."""

SECONDS = 900
"""A mutant that makes the tests take longer is caught: it hangs."""


def stages_of(module: str) -> list[list[str]]:
    """Return what pytest is to run, stage by stage: the module's tests, all quick ones, all."""
    names = [name for name, modules in TESTS.items() if module in modules]
    own = f"test_{names[0] if names else Path(module).stem}.py"
    # What the documents name does not depend on any line of core.
    apart = {own, "test_documents.py"}
    paths = [path.relative_to(PROJECT) for path in sorted(PROJECT.glob("tests/core/test_*.py"))]
    others = [str(path) for path in paths if path.name not in apart]
    mine = [str(path) for path in paths if path.name == own]
    return [*([mine] if mine else []), [*others, "-m", "not slow"], [*others, "-m", "slow"]]


def outcome(module: str, old: str, new: str) -> str:
    """Return the first test that fails with the fault in, or "" if none does.

    Raises
    ------
    ValueError
        If the line to change does not stand in the module exactly once.
    """
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in ("refine_addon", "tests", "benchmarks", ".ci", "docs"):
            shutil.copytree(PROJECT / name, copy / name, ignore=shutil.ignore_patterns("e2e"))
        for name in ("pyproject.toml", "blender_manifest.toml", "README.md", "CONTRIBUTING.md"):
            shutil.copy(PROJECT / name, copy / name)
        path = copy / "refine_addon/core" / module
        text = path.read_text("utf-8")
        if text.count(old) != 1:
            msg = f"expected {old!r} once, found it {text.count(old)} times"
            raise ValueError(msg)
        path.write_text(text.replace(old, new), "utf-8")
        for stage in stages_of(module):
            caught = _caught(copy, stage)
            if caught:
                return caught
    return ""


def _caught(copy: Path, stage: list[str]) -> str:
    """Return the first of some tests that fails in a copy of the project, or ""."""
    tests = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *stage]
    # Those that race against a clock could catch a fault by chance.
    tests += ["-k", "not interrupted and not killed"]
    try:
        done = subprocess.run(
            tests, cwd=copy, capture_output=True, text=True, check=False, timeout=SECONDS
        )
    except subprocess.TimeoutExpired:
        return f"more than {SECONDS} s"
    if done.returncode == 0:
        return ""
    if "error" in done.stdout.splitlines()[-1]:
        raise ValueError(done.stdout[-2000:])  # a test that cannot be collected catches nothing
    found = re.search(r"^FAILED \S*?/?([^/\s]+?)(?:\[| |$)", done.stdout, re.MULTILINE)
    return found[1] if found else done.stdout[-200:]


def main() -> int:
    """Try every mutant, or those of some modules; return 1 if one survives."""
    if outcome("splats.py", "SH_C0 = ", "SH_C0 = "):
        print("the tests fail without any fault: mend that first")
        return 1
    tried = survivors = stale = 0
    for module in sys.argv[1:] or MUTANTS:
        for old, new, label in MUTANTS[module]:
            tried += 1
            try:
                caught = outcome(module, old, new)
            except ValueError as error:
                stale += 1
                print(f"{label:34} {module:24} NOT TRIED: {error}", flush=True)
                continue
            survivors += not caught
            print(f"{label:34} {module:24} {caught or 'SURVIVED'}", flush=True)
    print(f"{tried} faults, {survivors} survived, {stale} not tried")
    return 1 if survivors or stale else 0


if __name__ == "__main__":
    sys.exit(main())
