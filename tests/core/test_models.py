"""How splats are drawn: what files say of it, and that it survives them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import RefineError, Splats, read_splats
from refine_addon.core.formats import ply_header
from refine_addon.core.formats.ply_columns import columns_from_splats
from refine_addon.core.formats.registry import FORMATS
from refine_addon.core.operation.files import file_to_file
from refine_addon.core.operation.requests import ConvertRequest
from refine_addon.core.rendering import MODELS
from refine_addon.core.splats import LOG_ZERO


def cloud(count, seed=0):
    """Return splats of all shapes; all numbers are floats of single precision."""
    random = np.random.default_rng(seed)
    return Splats(
        means=random.normal(size=(count, 3)).astype(np.float32),
        log_scales=random.uniform(-5.0, -2.0, (count, 3)).astype(np.float32),
        quaternions=random.normal(size=(count, 4)).astype(np.float32),
        opacity_logits=random.normal(size=count).astype(np.float32),
        sh_dc=random.normal(size=(count, 3)).astype(np.float32),
        sh_rest=np.zeros((count, 0, 3), np.float32),
    )


def write(path, splats, comments=()):
    """Write splats as a plain PLY whose header has these comments."""
    columns = columns_from_splats(splats)
    header = ply_header.new_header(((name, "float") for name in columns), len(splats)).split(b"\n")
    header[1:1] = [b"comment " + comment for comment in comments]
    path.write_bytes(b"\n".join(header) + np.column_stack([*columns.values()]).tobytes())
    return path


@pytest.mark.parametrize(
    ("comments", "model"),
    [
        ([], "default"),
        ([b"SplatRenderMode: mip"], "antialiased"),
        ([b"splatrendermode:  MIP "], "antialiased"),
        ([b"SplatRenderMode: 2dgs"], "2dgs"),
        ([b"antialiased 1"], "antialiased"),
        ([b"antialiased 0"], "default"),
        ([b"antialiased 1", b"SplatRenderMode: default"], "default"),
        ([b"SplatRenderMode: something new"], "default"),
        ([b"of antialiased 1"], "default"),
    ],
)
def test_comments_of_a_ply_say_how_it_is_drawn(tmp_path, comments, model):
    """Brush's and Postshot's; of several the last counts, and what nobody knows does not."""
    file = read_splats(write(tmp_path / "in.ply", cloud(5), comments))

    assert file.model == file.splats().model == model
    assert file.splats().take(slice(2)).model == model


def test_splats_without_a_third_scale_are_discs_and_stay_so(tmp_path):
    """They are read as of size 0 along their third axis, and written without it."""
    splats = replace(cloud(5), model="2dgs")
    path = write(tmp_path / "in.ply", splats, [b"antialiased 1"])
    assert b"scale_2" not in path.read_bytes()

    file_to_file(path, tmp_path / "out.ply", ConvertRequest())

    read = read_splats(tmp_path / "out.ply")
    assert read.model == "2dgs"
    np.testing.assert_array_equal(read.splats().log_scales[:, 2], np.float32(LOG_ZERO))
    np.testing.assert_array_equal(read.splats().log_scales[:, :2], splats.log_scales[:, :2])
    assert (tmp_path / "out.ply").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("form", FORMATS, ids=lambda form: form.suffix)
def test_a_format_tells_the_model_or_its_notes_do(tmp_path, form, model):
    """Every tag that a format holds comes back from it; of the others is said how to read it."""
    source = write(tmp_path / "in.ply", cloud(40))
    between, back = tmp_path / f"between{form.suffix}", tmp_path / "back.ply"

    report = file_to_file(source, between, ConvertRequest(model=model)).report
    file_to_file(between, back, ConvertRequest())

    held = model in form.models
    assert read_splats(back).model == (model if held else "default")
    assert any(f"--model {model}" in note for note in report["notes"]) != held


def test_what_is_asked_for_replaces_what_the_file_says(tmp_path):
    path = write(tmp_path / "in.ply", cloud(5), [b"SplatRenderMode: mip", b"by hand"])

    file = read_splats(path, "2dgs")
    plain = read_splats(path, "default")

    assert file.model == "2dgs"
    assert b"comment SplatRenderMode: 2dgs\n" in file.header
    assert plain.model == "default"
    assert b"mip" not in plain.header
    assert b"comment by hand\n" in plain.header
    assert read_splats(path, "antialiased").header == read_splats(path).header


@pytest.mark.parametrize(
    ("model", "expected"),
    [("default", "in.ply: splats without scale_2 are drawn as 2dgs, got default"),
     ("mip", "model is 'mip', expected one of default, antialiased, 2dgs")],
)  # fmt: skip
def test_a_model_that_cannot_be_is_refused(tmp_path, model, expected):
    path = write(tmp_path / "in.ply", replace(cloud(5), model="2dgs"))

    with pytest.raises(RefineError) as caught:
        read_splats(path, model)

    assert expected in str(caught.value)
