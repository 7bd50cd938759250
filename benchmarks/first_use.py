"""First use of commands: CPU time with an empty cache and with a warm one, of two source trees in one run.

    python benchmarks/first_use.py --folder /tmp/first-use --base /path/to/an/older/checkout

Each command runs with an empty cache, and then with a warm one. CPU times are user plus
system time of the command and its workers. Detached processes that go on generating code are
counted apart: Linux tells their times (/proc). ``memory`` is the largest resident set of a process.
Results are stored in FOLDER/results.json after every command, and a second call goes on with those
that are missing. The interpreter of a checkout is its .venv/bin/python.
"""

import argparse
import json
import os
import shutil
import subprocess
import time
from contextlib import suppress
from pathlib import Path

HERE = Path(__file__).parents[1]
COMMANDS = {
    "make-dataset airhockey-hit": "make-dataset airhockey-hit --n 400 -o OUT/hits --workers 1",
    "make-dataset airhockey-replan": "make-dataset airhockey-replan --n 400 -o OUT/replans --workers 1",
    "make-dataset heavy-object-anywhere": "make-dataset heavy-object-anywhere --n 400 -o OUT/anywhere --workers 1",
    "plan airhockey-hit": "plan INPUTS/hits --model airhockey-hit --n 4 -o OUT/plans.h5",
    "evaluate": "evaluate INPUTS/plans.h5",
    "refine": "refine INPUTS/plans.h5 -o OUT/refined.h5",
    "solve airhockey-hit": "solve airhockey-hit --n 4 -o OUT/solved.h5",
    "solve heavy-object": "solve heavy-object --n 4 -o OUT/solved.h5",
    "solve clutter": "solve datasets/suites/clutter.h5 --robot panda-3kg --n 3 -o OUT/solved.h5",
    "solve turret": "solve INPUTS/turret/pipeline.toml --n 4 -o OUT/solved.h5",
    "solve an arm by init": "solve INPUTS/arm/pipeline.toml --n 4 -o OUT/solved.h5",
    "train, 20 steps": "train INPUTS/hits --steps 20 -o OUT/model.h5",
}  # fmt: skip
ARM = "init OUT/arm --urdf problems/heavy-object/iiwa14_object.urdf"
TURRET = "init OUT/turret --urdf INPUTS/turret.urdf --tip tool"
TUTORIAL = HERE / "docs/tutorials/your-arm.md"  # contains the turret's URDF
MAX_BACKGROUND_S = 300
POLL_INTERVAL_S = 0.05


def run(tree: Path, command: str, folder: Path, cache: Path) -> dict[str, float]:
    """Run a command of a tree; return CPU times until its end and in the background [s], and memory [MB]."""
    shutil.rmtree(folder / "out", ignore_errors=True)
    (folder / "out").mkdir()
    words = command.replace("OUT", str(folder / "out"))
    words = words.replace("INPUTS", str(folder / "inputs"))
    variables = {**os.environ, "CNPGEN_CACHE": str(cache), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [tree / ".venv/bin/python", "-m", "cnpgen", *words.split(), "--quiet"],
        env=variables,
        cwd=tree,
        stdout=subprocess.DEVNULL,
    )
    background, waited_for = dict[int, float](), set[int]()
    # The usage is that of this command alone; RUSAGE_CHILDREN has the memory of all before.
    ended, status, usage = os.wait4(process.pid, os.WNOHANG)
    while not ended:
        background |= background_times(cache)
        # The command has waited for these: their times count as its own.
        waited_for = {each for each in background if not Path(f"/proc/{each}").exists()}
        time.sleep(POLL_INTERVAL_S)
        ended, status, usage = os.wait4(process.pid, os.WNOHANG)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{command}: exit code {process.returncode}")
    times = usage.ru_utime + usage.ru_stime
    times -= sum(background[each] for each in waited_for)
    begun = time.monotonic()
    while running := background_times(cache):
        background |= running
        if time.monotonic() - begun > MAX_BACKGROUND_S:
            raise SystemExit(f"requests in {cache} are not fulfilled")
        time.sleep(POLL_INTERVAL_S)
    return {
        "cpu": times,
        "background": sum(background.values()),
        "memory": usage.ru_maxrss / 1000,
    }


def background_times(cache: Path) -> dict[int, float]:
    """Return the CPU times [s] of the detached processes of a cache that run now, by their identifiers."""
    times = {}
    for folder in Path("/proc").glob("[0-9]*"):
        # A process may end while it is read.
        with suppress(OSError):
            words = (folder / "cmdline").read_bytes().decode().split("\0")
            if "cnpgen.kernels.optimizer" in " ".join(words) and str(cache) in words:
                numbers = (folder / "stat").read_text().rpartition(")")[2].split()
                ticks = int(numbers[11]) + int(numbers[12])
                times[int(folder.name)] = ticks / os.sysconf("SC_CLK_TCK")
    return times


def measure(tree: Path, command: str, folder: Path) -> dict[str, float]:
    """Measure a command with an empty cache and with a warm one."""
    cache = (folder / "cache").absolute()
    shutil.rmtree(cache, ignore_errors=True)
    cold = run(tree, command, folder, cache)
    warm = min(run(tree, command, folder, cache)["cpu"] for _ in range(3))
    return cold | {"warm": warm}


def make_inputs(folder: Path) -> None:
    """Make the dataset, plans and recipes that commands read, with a cache of their own."""
    inputs = folder / "inputs"
    if not (inputs / "turret").exists():
        shutil.rmtree(inputs, ignore_errors=True)
        inputs.mkdir(parents=True)
        text = TUTORIAL.read_text(encoding="utf-8")
        turret = text[text.index("<robot") : text.index("END\n```")]
        (inputs / "turret.urdf").write_text(turret, encoding="utf-8")
        names = "make-dataset airhockey-hit", "plan airhockey-hit"
        cache = folder / "cache-of-inputs"
        for command in (*(COMMANDS[name] for name in names), ARM, TURRET):
            run(HERE, command.replace("OUT", str(inputs)), folder, cache)


def main() -> None:
    """Measure what is missing and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--base", type=Path, help="another checkout to compare with")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    make_inputs(options.folder)
    store = options.folder / "results.json"
    results = json.loads(store.read_text()) if store.exists() else {}
    trees = {"here": HERE, **({"base": options.base.resolve()} if options.base else {})}
    for name, command in COMMANDS.items():
        for label, tree in trees.items():
            key = f"{name}, {label}"
            if key not in results:
                results[key] = measure(tree, command, options.folder)
                store.write_text(json.dumps(results, indent=2))
            names = "cpu", "background", "memory", "warm"
            cold, background, memory, warm = (results[key][name] for name in names)
            print(
                f"{key}: empty {cold:.1f} s, warm {warm:.1f} s, above warm {cold - warm:.1f} s"
                f" ({cold / warm:.1f} times), background {background:.1f} s, {memory:.0f} MB",
                flush=True,
            )
        if options.base:
            here, base = (results[f"{name}, {label}"] for label in ("here", "base"))
            ratios = ", ".join(f"{k} {here[k] / base[k]:.2f}" for k in ("cpu", "warm"))
            print(f"{name}, here / base: {ratios}", flush=True)


if __name__ == "__main__":
    main()
