# SPDX-License-Identifier: Apache-2.0
"""The gallery has a small animation of every shipped scene, none of them empty, and a page of them."""

from pathlib import Path

import gallery
import numpy as np
import pytest
from PIL import Image

from warpmpc import shipped_scenes

FOLDER = Path(__file__).parents[2] / "docs/gallery"


@pytest.mark.parametrize("name", shipped_scenes())
def test_every_scene_is_shown(name):
    path = FOLDER / f"{name}.webp"
    assert path.stat().st_size < 600_000
    with Image.open(path) as moving:
        assert moving.n_frames > 10
        frames = []
        for n in (0, moving.n_frames // 2, moving.n_frames - 1):
            moving.seek(n)
            frames.append(np.asarray(moving.convert("RGB"), dtype=float))
    assert all(frame.shape[1] == gallery.WIDTH and frame.std() > 10.0 for frame in frames)
    assert all(60.0 < frame.mean() < 220.0 for frame in frames)  # neither night nor fog
    assert max(np.abs(frame - frames[0]).max() for frame in frames) > 50.0  # something moves


def test_the_gallery_is_small_and_has_no_scene_that_is_gone():
    files = list(FOLDER.iterdir())
    assert {file.stem for file in files} == set(shipped_scenes())
    assert sum(file.stat().st_size for file in files) < 12_000_000


def test_the_page_is_what_the_tool_writes():
    assert gallery.PAGE.read_text(encoding="utf-8") == gallery.page()


def test_a_camera_sees_all_points_and_no_more_than_it_must():
    points = np.random.default_rng(0).uniform([-1.0, 2.0, 0.0], [3.0, 3.0, 0.5], size=(200, 3))
    look = gallery.framed(points, gallery.Shot())
    azimuth, elevation = np.radians([look.azimuth, look.elevation])
    ahead = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    eye = look.lookat - look.distance * ahead
    away = points - eye
    slope = np.tan(0.5 * gallery.FIELD)
    up = np.abs(away @ np.cross(right, ahead)) / (away @ ahead) / slope
    across = np.abs(away @ right) / (away @ ahead) / slope * gallery.SIZE[1] / gallery.SIZE[0]
    assert 0.85 < max(up.max(), across.max()) <= 1.0
