# SPDX-License-Identifier: Apache-2.0
"""Whatever is imported is also installed: every room is listed in pyproject.toml, with the files it reads."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_every_package_and_every_file_that_is_read_is_installed():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    listed = set(settings["packages"])
    rooms = {"warpmpc": ROOT / "warpmpc", "warpmpc.kernels": ROOT / "kernels"}
    found = {
        ".".join((name, *path.parent.relative_to(room).parts))
        for name, room in rooms.items()
        for path in room.rglob("__init__.py")
    }
    assert found <= listed
    headers = {path.parent for path in (ROOT / "warpmpc").rglob("*.h")}
    assert headers == {ROOT / "warpmpc/physics/native"}
    assert settings["package-data"]["warpmpc.physics"] == ["native/*.h"]
