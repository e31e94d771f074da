"""What a failing image test leaves behind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from failing_images import images_on_failure
from PIL import Image


def pixels(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path))


def test_a_failing_test_writes_its_images_and_names_their_folder(tmp_path: Path) -> None:
    reference = np.linspace(0.0, 1.0, 3 * 20 * 30).reshape(3, 20, 30)
    image = reference.copy()
    image[:, :10] += 0.2
    with pytest.raises(AssertionError, match=str(tmp_path / "uniform@left")):  # noqa: SIM117
        with images_on_failure("uniform@left", image, reference, tmp_path):
            assert np.array_equal(image, reference)
    folder = tmp_path / "uniform@left"
    assert sorted(path.name for path in folder.iterdir()) == ["difference.png", "image.png", "reference.png"]
    difference = pixels(folder / "difference.png").astype(int)
    assert difference.shape == (20, 30, 3)
    assert (difference[:10] > 160).all()  # too bright
    assert (abs(difference[10:] - 128) <= 1).all()  # equal
    assert pixels(folder / "image.png")[0, 0, 0] > pixels(folder / "reference.png")[0, 0, 0]


def test_a_test_that_passes_writes_nothing(tmp_path: Path) -> None:
    with images_on_failure("uniform@left", np.ones((1, 4, 4)), np.ones((1, 4, 4)), tmp_path):
        pass
    assert not list(tmp_path.iterdir())
