"""RAP's features, and its network from a file as PyTorch writes it; the weights are made up."""

from __future__ import annotations

import pickle
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("scipy")
pytest.importorskip("numba")
pytest.importorskip("skimage")

from benchmarks.baselines import rap
from benchmarks.tables import evaluate
from refine_addon.core.errors import RefineError
from tests.benchmarks.test_merging import scene_of

ROOM = Path(__file__).parents[1] / "data/room_small"


class Pickled:
    """Something that is pickled as a call of a function that is not here, as tensors are."""

    def __init__(self, module: str, name: str, *values: object) -> None:
        self.module, self.name, self.values = module, name, values


class TorchPickler(pickle._Pickler):
    """Writes what PyTorch writes, without PyTorch."""

    def persistent_id(self, value: object) -> object:
        """Return what stands for the numbers of a tensor, which lie elsewhere."""
        return value.values if isinstance(value, Pickled) and not value.name else None

    def save(self, value, save_persistent_id=True):
        """Write a value, or the call that `Pickled` stands for."""
        if isinstance(value, Pickled) and value.name:
            self.write(f"c{value.module}\n{value.name}\n".encode())
            if value.values:
                super().save(value.values)
                self.write(pickle.REDUCE)
        else:
            super().save(value, save_persistent_id)


def write_weights(path: Path, tensors: list[np.ndarray]) -> Path:
    """Write tensors as ``torch.save`` does: a pickle, and the numbers of each in a member."""
    kind = Pickled("torch", "FloatStorage")
    state = {
        f"model.{index}": Pickled(
            "torch._utils", "_rebuild_tensor_v2",
            Pickled("", "", "storage", kind, str(index), "cuda:0", tensor.size),
            0, tensor.shape, (), False, {},
        )
        for index, tensor in enumerate(tensors)
    }  # fmt: skip
    with zipfile.ZipFile(path, "w") as archive:
        with archive.open("net/data.pkl", "w") as stream:
            TorchPickler(stream, 2).dump(state)
        for index, tensor in enumerate(tensors):
            archive.writestr(f"net/data/{index}", tensor.astype("<f4").tobytes())
    return path


def pointing(feature: int) -> list[np.ndarray]:
    """Return a network of one hidden unit whose score is a feature times 3, less 1.

    relu(2 f + 1) is 2 f + 1; the outputs are 1.5 times that, and 2.5.
    """
    first = np.zeros((1, rap.FEATURES))
    first[0, feature] = 2.0
    return [first, np.ones(1), np.array([[1.5], [0.0]]), np.array([0.0, 2.5])]


def test_the_network_is_read_and_evaluated(tmp_path: Path) -> None:
    """Weights that pick one feature out give it back, scaled and shifted."""
    splats = scene_of()

    for feature in (0, 14):
        weights = write_weights(tmp_path / "net.pth", pointing(feature))
        expected = 3.0 * rap.features(splats)[:, feature] - 1.0
        np.testing.assert_allclose(rap.score(splats, weights), expected, atol=1e-6)


def test_features_are_in_their_order_and_within_0_and_1() -> None:
    """Each grows with what it is made of: a splat far off, colourful, large and opaque.

    Columns 0 and 1 distance, 2 and 3 colour spread, 4 to 6 and 7 to 9 scales from short to long,
    10 and 11 volume, 12 and 13 opacity, 14 colour. All of splat 0's are at the 99th percentile.
    """
    splats = scene_of()
    changes = {}
    for name, value in (
        ("means", [3.0, 3.0, 3.0]),
        ("log_scales", [2.0, 1.0, 3.0]),
        ("opacity_logits", 9.0),
        ("sh_dc", 9.0),
    ):
        changes[name] = getattr(splats, name).copy()
        changes[name][0] = value
    changes["sh_rest"] = 0.01 * splats.sh_rest
    plain = rap.features(replace(splats, **changes))
    changes["sh_dc"][0], changes["sh_rest"][0] = 0.0, 4.0
    colorful = rap.features(replace(splats, **changes))

    assert plain.shape == (400, rap.FEATURES)
    assert plain.min() == 0.0
    assert plain.max() == 1.0
    np.testing.assert_allclose(plain[0, [0, 1, *range(4, 15)]], 1.0)
    np.testing.assert_allclose(colorful[0, 2:4], 1.0)
    assert plain[0, 3] < 1.0


def test_local_features_compare_with_neighbours_and_global_ones_with_all() -> None:
    """A small splat among tiny ones stands out there, though most splats elsewhere are larger."""
    splats = scene_of()
    means, logs = splats.means.copy(), np.full((400, 3), -2.0, np.float32)
    means[:150] += 9.0
    logs[:150] = -6.0
    logs[0] = -4.0
    logs += np.random.default_rng(1).normal(scale=0.01, size=logs.shape).astype(np.float32)

    found = rap.features(replace(splats, means=means, log_scales=logs))

    assert found[0, 10] == 1.0
    assert found[0, 11] < 0.6


def test_splats_in_one_place_and_alike_have_finite_features() -> None:
    """Distances of 0 have no logarithm, and values that do not vary no standard deviation."""
    same = scene_of(200).take(np.zeros(200, np.int64))

    assert np.isfinite(rap.features(same)).all()


def test_directions_are_spread_evenly() -> None:
    """Unit vectors whose mean is 0 and whose second moments are a third each."""
    directions = rap.fibonacci(rap.DIRECTIONS)

    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    np.testing.assert_allclose(directions.mean(axis=0), 0.0, atol=0.02)
    np.testing.assert_allclose(directions.T @ directions / 60, np.eye(3) / 3, atol=0.01)


@pytest.mark.parametrize(
    "tensors",
    [
        [np.ones((2, 14)), np.ones(2)],
        [np.ones((3, 15)), np.ones(3)],
        [np.ones((2, 15))],
        [],
    ],
    ids=["14 features", "3 outputs", "no bias", "nothing"],
)
def test_another_network_is_refused(tmp_path: Path, tensors: list[np.ndarray]) -> None:
    """With its file and what was found in it."""
    weights = write_weights(tmp_path / "net.pth", tensors)

    with pytest.raises(RefineError, match=r"net\.pth: expected layers from 15 features"):
        rap.read_weights(weights)


def test_a_file_that_would_run_code_is_refused(tmp_path: Path) -> None:
    """A pickle can name any function; only those that rebuild tensors are known."""
    path = tmp_path / "net.pth"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("net/data.pkl", pickle.dumps(print))

    with pytest.raises(RefineError, match=r"print is not allowed"):
        rap.read_weights(path)


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> evaluate.Scene:
    """500 splats of the room and one held-out view, in place of any scene that is read."""
    room = evaluate.read_scene(ROOM)
    few = replace(room, splats=room.splats.take(slice(500)), test=room.test.spread(1), pictures={})
    monkeypatch.setattr(evaluate, "read_scene", lambda _: few)
    return few


@pytest.mark.usefixtures("few")
def test_rap_is_a_line_of_the_table_where_its_weights_are_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """And only there."""
    weights = write_weights(tmp_path / "net.pth", pointing(12))
    arguments = [str(ROOM), "--method", "random", "--ratios", "0.5", "--metrics", "psnr"]
    names = []

    for given in ([], ["--rap", str(weights)]):
        assert evaluate.main([*arguments, *given]) == 0
        lines = capsys.readouterr().out.splitlines()[3:]
        names.append([line.split()[0] for line in lines])

    assert names == [["unpruned", "random"], ["unpruned", "random", "rap"]]


@pytest.mark.usefixtures("few")
def test_rap_is_part_of_the_trade_where_its_weights_are_given(tmp_path: Path) -> None:
    """A line of the tables, as any method of the literature."""
    pytest.importorskip("matplotlib")
    from benchmarks.tables import trade

    weights = write_weights(tmp_path / "net.pth", pointing(12))
    arguments = [
        "--methods",
        "random",
        "rap",
        "--ratios",
        "0.5",
        "--runs",
        "1",
        "--compared",
        "1",
        "--metrics",
        "psnr",
    ]
    output = tmp_path / "trade.md"

    code = trade.main([str(ROOM), *arguments, "--parts", "methods", "--rap", str(weights),
                       "--output", str(output)])  # fmt: skip

    assert code == 0
    assert "- rap: a trained network" in output.read_text()
