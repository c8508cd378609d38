"""The gallery: every picture that the library draws, from the model to the file."""

import pytest


def test_every_picture_is_saved(tmp_path):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    from examples.formulating import gallery

    gallery.main(["--output", str(tmp_path)])
    sizes = {path.stem: path.stat().st_size for path in tmp_path.glob("*.png")}
    assert len(sizes) == 7
    assert min(sizes.values()) > 10_000
    matplotlib.pyplot.close("all")
