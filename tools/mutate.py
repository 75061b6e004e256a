# SPDX-License-Identifier: Apache-2.0
"""Small faults in lines of the product, and which test sees each: what the tests protect.

    python tools/mutate.py --count 20 --jobs 2 --out mutants.jsonl
    python tools/mutate.py --base COMMIT --out mutants.jsonl    # also with the code and tests of an older commit

Draws faults from a seed: a sign, comparison, branch, number, min and max, ``and`` and ``or``. Each goes into a copy of
the tree, where the tests nearest to it run, cheapest first. A test kills a fault if it fails again with it and passes
without it. Results are written as they come, and a second call goes on with what is missing. ``--base`` runs the
faults whose line is found once in both trees there, too.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import queue
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from xml.etree import ElementTree

from shared.faults import Fault, faults

ROOT = Path(__file__).parents[1]
OUTSIDE = ("tests/tools/", "tests/test_packages.py", "tests/test_readme.py")
"""Tests of what is around the product."""


class Tree:
    """A commit's files: product, tests, and what imports what."""

    def __init__(self, root: Path, seconds: dict[str, float]):
        self.root, self.seconds = root, seconds
        self.product = {
            str(p.relative_to(root)): p.read_text()
            for d in ("warpmpc", "kernels")
            for p in sorted((root / d).rglob("*.py"))
        }
        files = {str(p.relative_to(root)): p.read_text() for p in sorted((root / "tests").rglob("*.py"))}
        self.tests = {k: v for k, v in files.items() if "/test_" in k and not k.startswith(OUTSIDE)}
        self.importers = defaultdict(set)  # file -> files that import it
        home = re.search(r"^_HOME = (\{.*?^\})", self.product["warpmpc/__init__.py"], re.M | re.S)
        home = ast.literal_eval(home[1]) if home else {}
        for path, source in (self.product | files).items():
            for node in ast.walk(ast.parse(source)):
                if isinstance(node, ast.ImportFrom):
                    here = ("warpmpc/" + path if path.startswith("kernels") else path).split("/")[: -node.level or None]
                    name = ".".join([*(here if node.level else []), *([node.module] if node.module else [])])
                    for alias in node.names:
                        public = f"warpmpc.{home.get(alias.name, 'kernels.cost.view')}" if name == "warpmpc" else name
                        for target in (f"{name}.{alias.name}", public):
                            self.importers[self._file(target)].add(path)
                elif isinstance(node, ast.Import):
                    for alias in node.names:
                        self.importers[self._file(alias.name)].add(path)
        del self.importers[""]

    def _file(self, module: str) -> str:
        path = (
            module.replace(".", "/").removeprefix("warpmpc/")
            if "warpmpc.kernels" in module
            else module.replace(".", "/")
        )
        names = (f"{path}.py", f"{path}/__init__.py", f"tests/helpers/{path}.py")
        return next((n for n in names if n in self.product or (self.root / n).is_file()), "")

    def near(self, fault: Fault) -> list[str]:
        """Test files, from the one that most likely sees a fault at least cost."""
        # the module, kernels that few but it launch, and who launches a kernel
        users = {k: v & set(self.product) for k, v in self.importers.items() if k.startswith("kernels")}
        edge = [fault.path, *sorted(k for k, v in users.items() if fault.path in v and len(v) < 4 and k != fault.path)]
        edge += sorted(x for x in users.get(fault.path, ()) if len(users[fault.path]) < 4 and x not in edge)
        rooms = {x for p in edge for x in Path(p).parts[:-1]} - {"warpmpc", "kernels"}
        folders = {Path(p).parent.name for p in edge}
        distance = dict.fromkeys(edge, 0)
        for path in edge:
            for importer in sorted(self.importers[path] - set(distance)) if path != "warpmpc/__init__.py" else []:
                distance[importer] = distance[path] + 1
                edge.append(importer)
        stem, name = Path(fault.path).stem.removesuffix("s"), fault.inside.strip("_")

        def cost(test: str) -> float:
            steps = min(distance.get(test, 5), 5)
            if rooms & set(Path(test).parts):
                steps = min(steps, 3) - 1 - bool(folders & set(Path(test).parts))
            steps -= (stem in test) + bool(name and re.search(rf"\b_?{name}\b", self.tests[test]))
            return (3.0 + self.seconds.get(Path(test).stem, len(self.tests[test]) / 1000)) * 3.0**steps

        return sorted(self.tests, key=cost)


class Copy:
    """A copy of a tree in which one fault after another is put."""

    def __init__(self, tree: Tree, folder: Path):
        self.tree, self.root, self.temporary = tree, folder / "tree", folder / "tmp"
        left_out = shutil.ignore_patterns(".git", ".venv*", "__pycache__", ".hypothesis", ".pytest_cache")
        shutil.copytree(tree.root, self.root, ignore=left_out, symlinks=True)
        self.temporary.mkdir()
        # sources are compared, not their times: a fault is as old and as long as what it replaces
        cached = ["-m", "compileall", "-q", "--invalidation-mode", "checked-hash", "warpmpc", "kernels"]
        subprocess.run([sys.executable, *cached], cwd=self.root, check=True)

    def put(self, fault: Fault, *, there: bool) -> None:
        """Put a fault into the copy, or take it out."""
        lines = self.tree.product[fault.path].splitlines(keepends=True)
        if there:
            line = lines[fault.line - 1]
            lines[fault.line - 1] = line[: fault.column] + fault.new + line[fault.column + len(fault.old) :]
        (self.root / fault.path).write_text("".join(lines))

    def run(self, tests: list[str], deadline: float, options: list[str]) -> tuple[str, str]:
        """Outcome ``passed``, ``failed`` or ``limit`` of tests, and the last one that ran."""
        environment = os.environ | {
            "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
            "TMPDIR": str(self.temporary),
            "CUDA_VISIBLE_DEVICES": "",
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        command = [
            "tools/gpu_run",
            sys.executable,
            "-m",
            "pytest",
            "-v",
            "-x",
            "--tb=no",
            "--timeout=60",
            "--timeout-method=thread",
            "-p",
            "no:cacheprovider",
        ]
        command += ["--disable-warnings", "-o", "addopts=", "-m", "not slow", *options, *tests]
        with tempfile.TemporaryFile() as out:
            process = subprocess.Popen(
                command,
                cwd=self.root,
                env=environment,
                stdout=out,
                stderr=out,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )
            try:
                code = process.wait(max(1.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                code = None
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            out.seek(0)
            said = out.read().decode(errors="replace")
        shutil.rmtree(self.temporary, ignore_errors=True)
        self.temporary.mkdir()
        ran = re.findall(
            r"^(?:ERROR )?(tests/\S+\.py(?:::.+?)?)(?: (?:PASSED|FAILED|ERROR|SKIPPED|XFAIL|XPASS)| - |$)", said, re.M
        )
        outcome = "limit" if code is None else "passed" if code in (0, 5) else "failed"
        return outcome, ran[-1].partition(" Fatal Python")[0].strip() if ran else said[-300:]


class Trial:
    """Faults run in copies of trees, results written as they come."""

    def __init__(self, arguments: argparse.Namespace, trees: dict[str, Tree], folder: Path):
        self.arguments, self.trees = arguments, trees
        self.end = time.monotonic() + arguments.limit
        self.copies = {name: queue.SimpleQueue() for name in trees}
        self.lock, self.broken = threading.Lock(), {name: set() for name in trees}
        self.sound = {name: set() for name in trees}  # tests that pass without a fault
        for name, tree in trees.items():
            for job in range(arguments.jobs):
                self.copies[name].put((tree, folder / f"{name}{job}"))

    def judge(self, name: str, fault: Fault, number: int) -> None:
        """Run the tests that are near a fault and write its fate."""
        if time.monotonic() > self.end:
            return
        copy = self.copies[name].get()
        copy = Copy(*copy) if isinstance(copy, tuple) else copy
        start = time.monotonic()
        last = min(self.end, start + self.arguments.each)
        tests, fate, test, own, size = self.trees[name].near(fault), "", "", set(), 6  # pytest collects all it is given
        copy.put(fault, there=True)
        while not fate:
            left_out = [f"--deselect={t}" for t in sorted(own | self.broken[name])]
            outcome, test = copy.run(tests[:size], last, left_out)
            if outcome == "passed" and tests[size:]:
                tests, size = tests[size:], 3 * size
            elif outcome != "failed":
                fate = "survived"
            elif "::" not in test or test in own | self.broken[name]:  # a file, or all of pytest, does not load
                file = test.partition("::")[0] if test.startswith("tests/") else tests[0]
                copy.put(fault, there=False)
                loads = copy.run([file], self.end, ["--co"])[0] == "passed"
                copy.put(fault, there=True)
                fate = "killed" if loads and "::" not in test else ""
                tests.remove(file)
            else:
                if test not in self.sound[name]:
                    copy.put(fault, there=False)
                    if copy.run([test], self.end, [])[0] == "passed":
                        self.sound[name].add(test)
                    copy.put(fault, there=True)
                if test not in self.sound[name]:
                    self.broken[name].add(test)
                elif copy.run([test], self.end, [])[0] == "failed":
                    fate = "killed"
                own.add(test)
                tests = tests[tests.index(test.partition("::")[0]) :]
        copy.put(fault, there=False)
        self.copies[name].put(copy)
        if outcome == "limit" and time.monotonic() > self.end:
            return
        line = {"tree": name, "number": number, "fate": fate, "test": test, "limit": outcome == "limit"}
        line |= {"seconds": round(time.monotonic() - start, 1)} | asdict(fault)
        with self.lock, self.arguments.out.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")


def draw(tree: Tree, count: int, seed: int) -> list[Fault]:
    """Faults drawn from a seed, as many of each kind."""
    kinds, rng = defaultdict(list), random.Random(seed)
    for path, source in tree.product.items():
        for fault in faults(path, source):
            kinds[fault.kind].append(fault)
    for found in kinds.values():
        rng.shuffle(found)
    names = sorted(kinds)
    return [kinds[names[n % len(names)]].pop() for n in range(count)]


def survivors(tree: Tree, results: Path) -> dict[int, Fault]:
    """Faults that survived in a file of results, where their lines are today."""
    found = {}
    for r in map(json.loads, results.read_text(encoding="utf-8").splitlines()):
        if (r["tree"], r["fate"]) == ("now", "survived"):
            fault = Fault(**{key: r[key] for key in Fault.__dataclass_fields__})
            there = slice(fault.column, fault.column + len(fault.old))
            numbered = enumerate(tree.product[fault.path].splitlines(), 1)
            lines = [n for n, x in numbered if x.strip() == fault.text and x[there] == fault.old]
            if lines:
                found[r["number"]] = replace(fault, line=min(lines, key=lambda n: abs(n - r["line"])))
    return found


def same(fault: Fault, new: Tree, old: Tree) -> Fault | None:
    """A fault in an older tree, where its line is found once in both."""
    if [x.strip() for x in new.product[fault.path].splitlines()].count(fault.text) != 1:
        return None
    places = [
        (path, number, line)
        for path, source in old.product.items()
        for number, line in enumerate(source.splitlines(), 1)
        if line.strip() == fault.text
    ]
    named = [p for p in places if Path(p[0]).name == Path(fault.path).name]
    places = named or (places if len(fault.text) > 25 else [])
    if len(places) != 1:
        return None
    path, number, line = places[0]
    before = new.product[fault.path].splitlines()[fault.line - 1]
    shift = len(line) - len(line.lstrip()) - len(before) + len(before.lstrip())
    return replace(fault, path=path, line=number, column=fault.column + shift)


def table(results: list[dict]) -> None:
    """Print what was killed, by tree and room, and what survived."""
    both = {r["number"] for r in results if r["tree"] == "base"} & {r["number"] for r in results if r["tree"] == "now"}
    count = Counter()
    for r in results:
        for group in (r["kind"], r["path"].split("/")[-2 if r["path"].startswith("kernels") else 1], "all"):
            count[r["tree"], group, r["fate"]] += 1
        if r["number"] in both:
            count[r["tree"], "of both trees", r["fate"]] += 1
    for tree, group in sorted({key[:2] for key in count}):
        killed, survived = count[tree, group, "killed"], count[tree, group, "survived"]
        print(f"{tree:5} {group:16} {killed:4} of {killed + survived:4} killed, {killed / (killed + survived):4.0%}")
    for r in (r for r in results if r["fate"] == "survived"):
        cut = " (time was up)" if r["limit"] else ""
        print(f"{r['number']:4} {r['tree']:4} {r['path']}:{r['line']} {r['old']!r} -> {r['new']!r}{cut}: {r['text']}")


def main() -> None:
    """Draw faults, run tests and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200, help="faults to draw")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--each", type=float, default=480.0, help="seconds of tests for a fault")
    parser.add_argument("--limit", type=float, default=1e9, help="seconds for all")
    parser.add_argument("--base", help="an older commit, or a folder with its files")
    parser.add_argument("--times", type=Path, help="pytest's --junitxml of a whole run: cheap tests come first")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of faults")
    parser.add_argument("--again", type=Path, help="run what survived in a file of results, instead of a draw")
    parser.add_argument("--list", action="store_true", help="print the faults, run nothing")
    parser.add_argument(
        "--out", type=Path, default=Path("mutants.jsonl"), help="lines that are there are not run again"
    )
    arguments = parser.parse_args()

    seconds = Counter()
    for case in ElementTree.parse(arguments.times).iter("testcase") if arguments.times else ():
        seconds[case.get("classname", "").rpartition(".")[2]] += float(case.get("time", 0))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        trees = {"now": Tree(ROOT, seconds)}
        if arguments.again:
            drawn = survivors(trees["now"], arguments.again)
        else:
            drawn = dict(enumerate(draw(trees["now"], arguments.count, arguments.seed)))
        work = [("now", fault, n) for n, fault in drawn.items()]
        if arguments.base:
            base = Path(arguments.base)
            if not base.is_dir():
                base = folder / "base"
                base.mkdir()
                archive = subprocess.run(
                    ["git", "archive", arguments.base], cwd=ROOT, check=True, stdout=subprocess.PIPE
                )
                subprocess.run(["tar", "x"], cwd=base, input=archive.stdout, check=True)
            trees["base"] = Tree(base, seconds)
            older = [(same(fault, *trees.values()), n) for n, fault in drawn.items()]
            work += [("base", fault, n) for fault, n in older if fault]
        lines = arguments.out.read_text(encoding="utf-8").splitlines() if arguments.out.exists() else []
        done = {(r["tree"], r["number"]) for r in map(json.loads, lines)}
        work = [w for w in work if (w[0], w[2]) not in done and (arguments.only is None or w[2] in arguments.only)]
        if arguments.list:
            for tree, fault, n in work:
                print(f"{n:4} {tree:4} {fault.path}:{fault.line} {fault.old!r} -> {fault.new!r}: {fault.text}")
            return
        trial = Trial(arguments, trees, folder)
        with ThreadPoolExecutor(arguments.jobs) as pool:
            list(pool.map(lambda w: trial.judge(*w), work))
    table([json.loads(line) for line in arguments.out.read_text(encoding="utf-8").splitlines()])


if __name__ == "__main__":
    main()
