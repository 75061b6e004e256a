# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels on disk: what is damaged is built again, a folder that cannot be written is named in one line."""

import os
import re
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

RUN = """
import sys
import warp as wp
from warpmpc.physics.runtime.launch import Launcher

@wp.kernel(module="unique", enable_backward=False)
def double_kernel(x: wp.array[float]):
    x[wp.tid()] *= 2.0

if "silent" not in sys.argv:
    wp.config.log_level = wp.LOG_INFO
wp.init()
wp.config.kernel_cache_dir = sys.argv[1]
x = wp.full(3, 4.0, dtype=float, device="cpu")
Launcher("cpu")(double_kernel, 3, [], [x])
print(x.numpy().tolist())
"""
ANSWER = "[8.0, 8.0, 8.0]"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Starts a process that compiles a kernel, or takes it from a folder."""
    script = tmp_path_factory.mktemp("script") / "double.py"
    script.write_text(RUN)

    def run(folder: Path, *more: str, **options) -> subprocess.CompletedProcess:
        return subprocess.run(
            [sys.executable, script, folder, *more], capture_output=True, text=True, timeout=60, **options
        )

    return run


@pytest.fixture(scope="module")
def built(run, tmp_path_factory):
    """A folder with one kernel, and its files."""
    folder = tmp_path_factory.mktemp("kernels")
    done = run(folder)
    assert ANSWER in done.stdout, done.stderr
    assert re.search(r"double_kernel.*\(compiled\)", done.stdout)
    return folder, {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_nothing_is_printed_about_loaded_kernels_unless_a_program_asks(run, built):
    assert run(built[0], "silent").stdout == f"{ANSWER}\n"


def put_back(files: dict[Path, bytes]) -> None:
    for file, content in files.items():
        file.write_bytes(content)


def garbled(code: bytes) -> bytes:
    """The same with instructions in the middle that no processor has, of the same length."""
    middle = len(code) // 3
    return code[:64] + b"\x0f\x0b" * middle + code[64 + 2 * middle :]


DAMAGES = {
    "cut off": (".o", lambda code: code[: len(code) // 2]),
    "garbled": (".o", garbled),
    "without its description": (".meta", lambda text: text[: len(text) // 2]),
}


@pytest.mark.parametrize(("how", "signed"), [("garbled", True), ("without its description", True), ("cut off", False)])
def test_a_damaged_kernel_is_built_again_once(run, built, how, signed):
    folder, files = built
    put_back(files)
    end, damage = DAMAGES[how]
    (file,) = (file for file in files if file.suffix == end)
    file.write_bytes(damage(files[file]))
    for told in folder.rglob("*.sha256") if not signed else ():
        told.unlink()
    for told in ("(compiled)", "(cached)"):
        done = run(folder)
        assert done.returncode == 0, f"signal {-done.returncode}: {done.stderr[-2000:]}"
        assert ANSWER in done.stdout
        assert told in done.stdout


def test_a_whole_kernel_without_a_checksum_is_taken_and_gets_one(run, built):
    folder, files = built
    put_back(files)
    (told,) = folder.rglob("*.sha256")
    told.unlink()
    assert "(cached)" in run(folder).stdout
    assert told.read_bytes() == files[told]


def refused(done: subprocess.CompletedProcess, folder: Path) -> str:
    """The last line of a program that could not keep its kernels."""
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert f"compiled kernels cannot be kept in {folder}" in last
    assert last.endswith("make room there, or set WARP_CACHE_PATH")
    return last


def test_a_full_folder_is_named(run, tmp_path):
    def little_room():
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))

    assert "File too large" in refused(run(tmp_path, preexec_fn=little_room), tmp_path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere: run as another user")
def test_a_read_only_folder_is_named_where_a_kernel_is_missing(run, tmp_path):
    tmp_path.chmod(0o500)
    assert "Permission denied" in refused(run(tmp_path), tmp_path)


def test_a_command_names_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").touch()
    place = tmp_path / "file" / "kernels"
    command = [sys.executable, "-m", "warpmpc", "run", "point_reach"]
    environment = {**os.environ, "WARP_CACHE_PATH": str(place)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.strip().splitlines()
    assert re.fullmatch(rf"error: compiled kernels cannot be kept in {place}\S*: Not a directory; .*", line)


def test_headers_are_compiled_once_for_all_processes_and_again_where_they_are_damaged(run, built, tmp_path):
    shutil.copytree(built[0] / "headers", tmp_path / "headers")  # as another process left them
    (made,) = (tmp_path / "headers").glob("*/*")
    before = made.stat().st_mtime_ns

    def compiled() -> list[tuple[Path, int, int]]:
        for kernel in tmp_path.glob("wp_*"):
            shutil.rmtree(kernel)
        done = run(tmp_path)
        assert ANSWER in done.stdout, done.stderr
        assert "(compiled)" in done.stdout
        return [(file, file.stat().st_mtime_ns, file.stat().st_size) for file in (tmp_path / "headers").glob("*/*")]

    ((headers, made, size),) = compiled()
    assert made == before
    headers.write_bytes(headers.read_bytes()[: size // 2])
    assert compiled() == []  # without them
    (again,) = compiled()
    assert again[0] == headers
    assert again[1] > made
    assert again[2] == size


@pytest.fixture
def other(tmp_path):
    """A folder with its own Warp."""
    folder, warp = tmp_path / "other", Path(wp.__file__).parent
    shutil.copytree(warp, folder / "warp", ignore=shutil.ignore_patterns("bin", "tests", "examples"))
    (folder / "warp" / "bin").symlink_to(warp / "bin")
    return folder


def compiled_quietly(run, kernels: Path, **options) -> None:
    """Compile the kernel, whether or not it is there; nothing is said of headers."""
    for kernel in kernels.glob("wp_*"):
        shutil.rmtree(kernel)
    done = run(kernels, **options)
    assert ANSWER in done.stdout, done.stderr
    assert "(compiled)" in done.stdout
    assert "precompiled" not in done.stderr


def test_headers_of_an_environment_that_was_made_anew_or_is_gone_are_not_read(run, other, tmp_path):
    kernels, options = tmp_path / "kernels", {"env": {**os.environ, "PYTHONPATH": str(other)}}
    kernels.mkdir()
    compiled_quietly(run, kernels, **options)
    (first,) = (kernels / "headers").iterdir()
    for header in (other / "warp" / "native").rglob("*.h"):
        os.utime(header)
    compiled_quietly(run, kernels, **options)
    (second,) = (kernels / "headers").iterdir()
    assert second != first
    shutil.rmtree(other)
    compiled_quietly(run, kernels)
