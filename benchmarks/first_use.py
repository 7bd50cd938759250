"""First use of commands: CPU time with an empty cache and with a warm one, of two source trees in one run.

    python benchmarks/first_use.py --folder /tmp/first-use --base /path/to/an/older/checkout

Each command runs twice with one cache: at first empty, then warm. CPU times are user plus
system time of the command and its child processes; detached processes that go on generating
code are reported as the wait until no request is left, by their own clock. Results are stored
in FOLDER/results.json after every command, and a second call goes on with those that are missing.
The interpreter of a checkout is its .venv/bin/python.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import time
from pathlib import Path

HERE = Path(__file__).parents[1]
COMMANDS = {
    "make-dataset airhockey-hit": "make-dataset airhockey-hit --n 400 -o OUT/hits --workers 1",
    "plan airhockey-hit": "plan INPUTS/hits --model airhockey-hit --n 4 -o OUT/plans.h5",
    "refine": "refine INPUTS/plans.h5 -o OUT/refined.h5",
    "solve airhockey-hit": "solve airhockey-hit --n 4 -o OUT/solved.h5",
    "solve heavy-object": "solve heavy-object --n 4 -o OUT/solved.h5",
}  # fmt: skip
MAX_BACKGROUND_S = 300


def run(tree: Path, command: str, folder: Path, cache: Path) -> float:
    """Run a command of a tree and return its CPU time [s]."""
    shutil.rmtree(folder / "out", ignore_errors=True)
    (folder / "out").mkdir()
    words = command.replace("OUT", str(folder / "out"))
    words = words.replace("INPUTS", str(folder / "inputs"))
    variables = {**os.environ, "CNPGEN_CACHE": str(cache), "OMP_NUM_THREADS": "1"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [tree / ".venv/bin/python", "-m", "cnpgen", *words.split(), "--quiet"],
        check=True,
        env=variables,
        cwd=tree,
        stdout=subprocess.DEVNULL,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def wait_for_background(cache: Path) -> float:
    """Wait until no request for final code is left; return the time [s]."""
    begun = time.monotonic()
    while any((cache / "lib").glob("*.tape")):
        if time.monotonic() - begun > MAX_BACKGROUND_S:
            raise SystemExit(f"requests in {cache} are not fulfilled")
        time.sleep(0.1)
    return time.monotonic() - begun


def measure(tree: Path, command: str, folder: Path) -> dict[str, float]:
    """Measure a command with an empty cache, the wait for final code, and with a warm cache."""
    cache = folder / "cache"
    shutil.rmtree(cache, ignore_errors=True)
    cold = run(tree, command, folder, cache)
    background = wait_for_background(cache)
    return {
        "cold": cold,
        "background": background,
        "warm": min(run(tree, command, folder, cache) for _ in range(3)),
    }


def make_inputs(folder: Path) -> None:
    """Make the dataset and the plans that commands read, with a cache of their own."""
    inputs = folder / "inputs"
    if not (inputs / "plans.h5").exists():
        shutil.rmtree(inputs, ignore_errors=True)
        inputs.mkdir(parents=True)
        for name in ("make-dataset airhockey-hit", "plan airhockey-hit"):
            command = COMMANDS[name].replace("OUT", str(inputs))
            run(HERE, command, folder, folder / "cache-of-inputs")


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
            cold, wait, warm = (results[key][k] for k in ("cold", "background", "warm"))
            print(
                f"{key}: empty {cold:.1f} s, warm {warm:.1f} s, above warm {cold - warm:.1f} s"
                f" ({cold / warm:.1f} times), final code after {wait:.1f} s",
                flush=True,
            )
        if options.base:
            here, base = (results[f"{name}, {label}"] for label in ("here", "base"))
            ratios = ", ".join(f"{k} {here[k] / base[k]:.2f}" for k in ("cold", "warm"))
            print(f"{name}, here / base: {ratios}", flush=True)


if __name__ == "__main__":
    main()
