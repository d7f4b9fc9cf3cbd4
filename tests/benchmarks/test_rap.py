"""RAP's features, and its network from a file as PyTorch writes it; the weights are made up."""

import collections
import pickle
import sys
import types
import zipfile
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("scipy")

from benchmarks.baselines import rap
from refine_addon.core.errors import RefineError
from tests.benchmarks.scenes import cube_scene


@pytest.fixture
def weights_of(tmp_path, monkeypatch):
    """Return a function that writes tensors as ``torch.save`` does, without PyTorch.

    A pickle calls a function of it for each tensor, whose numbers lie in a member of their own.
    """

    def named(module, name):
        kind = type(name, (), {"__module__": module})
        monkeypatch.setitem(sys.modules, module, types.ModuleType(module))
        setattr(sys.modules[module], name, kind)
        return kind

    storage = named("torch", "FloatStorage")
    rebuild = named("torch._utils", "_rebuild_tensor_v2")

    class Tensor:
        def __init__(self, index, values):
            self.kept = "storage", storage, str(index), "cuda:0", values.size
            self.shape = values.shape

        def __reduce__(self):
            return rebuild, (Numbers(self.kept), 0, self.shape, (), False, {})

    class Numbers:
        def __init__(self, kept):
            self.kept = kept

    class Pickler(pickle.Pickler):
        def persistent_id(self, value):
            return value.kept if isinstance(value, Numbers) else None

    def write(tensors):
        state = {f"model.{index}": Tensor(index, each) for index, each in enumerate(tensors)}
        with zipfile.ZipFile(tmp_path / "net.pth", "w") as archive:
            with archive.open("net/data.pkl", "w") as stream:
                Pickler(stream, 2).dump(collections.OrderedDict(state))
            for index, tensor in enumerate(tensors):
                archive.writestr(f"net/data/{index}", tensor.astype("<f4").tobytes())
        return tmp_path / "net.pth"

    return write


@pytest.mark.parametrize("feature", [0, 14])
def test_the_network_is_read_and_evaluated(weights_of, feature):
    """One hidden unit: relu(2 f + 1) is 2 f + 1; the outputs are 1.5 times that, and 2.5."""
    first = np.zeros((1, rap.FEATURES))
    first[0, feature] = 2.0
    weights = weights_of([first, np.ones(1), np.array([[1.5], [0.0]]), np.array([0.0, 2.5])])

    expected = 3.0 * rap.features(cube_scene())[:, feature] - 1.0
    np.testing.assert_allclose(rap.score(cube_scene(), weights), expected, atol=1e-6)


def test_another_network_and_a_file_that_would_run_code_are_refused(weights_of, tmp_path):
    """A pickle can name any function; only those that rebuild tensors are known."""
    shapes = [[(2, 14), 2], [(3, 15), 3], [(2, 15)], []]
    for tensors in ([np.ones(shape) for shape in each] for each in shapes):
        with pytest.raises(RefineError, match=r"net\.pth: expected layers from 15 features"):
            rap.read_weights(weights_of(tensors))

    with zipfile.ZipFile(tmp_path / "net.pth", "w") as archive:
        archive.writestr("net/data.pkl", pickle.dumps(print))
    with pytest.raises(RefineError, match=r"print is not allowed"):
        rap.read_weights(tmp_path / "net.pth")


def test_features_are_in_their_order_and_within_0_and_1():
    """Each grows with what it is made of: a splat far off, colourful, large and opaque.

    Columns 0 and 1 distance, 2 and 3 colour spread, 4 to 6 and 7 to 9 scales from short to long,
    10 and 11 volume, 12 and 13 opacity, 14 colour. All of splat 0's are at the 99th percentile.
    """
    splats = cube_scene()
    extreme = {"means": 3.0, "log_scales": [2.0, 1.0, 3.0], "opacity_logits": 9.0, "sh_dc": 9.0}
    changes = {name: getattr(splats, name).copy() for name in extreme}
    for name, value in extreme.items():
        changes[name][0] = value
    changes["sh_rest"] = 0.01 * splats.sh_rest
    plain = rap.features(replace(splats, **changes))
    changes["sh_dc"][0], changes["sh_rest"][0] = 0.0, 4.0
    colorful = rap.features(replace(splats, **changes))

    assert plain.shape == (400, rap.FEATURES)
    assert (plain.min(), plain.max()) == (0.0, 1.0)
    np.testing.assert_allclose(plain[0, [0, 1, *range(4, 15)]], 1.0)
    np.testing.assert_allclose(colorful[0, 2:4], 1.0)
    assert plain[0, 3] < 1.0
