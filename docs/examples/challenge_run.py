"""Run the agent in the Air Hockey Challenge's own evaluator: success, penalties, and CPU time of its steps.

    python docs/examples/challenge_run.py --environment CLONE --episodes 30

Episodes are evaluated in chunks with one seed each, and a line follows every chunk.
"""

import argparse
import contextlib
import io
import json
import sys
import time
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

LIBRARIES = ("mushroom-rl", "mujoco", "numpy")


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--environment",
        type=Path,
        required=True,
        help="clone of the Air Hockey Challenge",
    )
    parser.add_argument("--episodes", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0, help="seed of the first chunk")
    parser.add_argument("--chunk", type=int, default=25, help="episodes of one seed")
    arguments = parser.parse_args()
    sys.path[:0] = [str(arguments.environment.resolve()), str(Path(__file__).parent)]
    try:
        from air_hockey_challenge.framework.evaluate_agent import evaluate
        from challenge_agent import HitAgent
    except (ImportError, OSError) as error:
        print(f"the environment cannot be imported: {error}", file=sys.stderr)
        return 3
    cpu, total = [], {"episodes": 0, "successes": 0, "penalty": 0.0, "violations": {}}

    class Timed(HitAgent):
        """Agent that records the CPU time of its steps."""

        def draw_action(self, observation):
            begun = time.process_time()
            action = super().draw_action(observation)
            cpu.append(time.process_time() - begun)
            return action

    def build(env_info, **_):
        agent = Timed(env_info)
        del cpu[len(cpu) - agent.warm_up_steps :]
        return agent

    while total["episodes"] < arguments.episodes:
        count = min(arguments.chunk, arguments.episodes - total["episodes"])
        seed = arguments.seed + total["episodes"] // arguments.chunk
        try:
            run_chunk(evaluate, build, count, seed, total)
        except (
            AttributeError,
            AssertionError,
            IndexError,
            KeyError,
            TypeError,
            ValueError,
        ) as error:
            installed = ", ".join(f"{name} {version(name)}" for name in LIBRARIES)
            print(
                f"unsupported versions ({installed}): {type(error).__name__}: {error}",
                file=sys.stderr,
            )
            return 3
        times = 1e3 * np.array(cpu)
        p50, p99, p999 = np.percentile(times, [50, 99, 99.9]).tolist()
        cpu_text = {
            "p50": round(p50, 2),
            "p99": round(p99, 2),
            "p99.9": round(p999, 2),
            "max": round(times.max(), 2),
        }
        print(
            json.dumps(
                {
                    **total,
                    "success": total["successes"] / total["episodes"],
                    "cpu_ms": cpu_text,
                }
            ),
            flush=True,
        )
    return 0


def run_chunk(evaluate, build, count: int, seed: int, total: dict) -> None:
    """Evaluate episodes of one seed and add the results."""
    text = io.StringIO()
    with TemporaryDirectory() as folder:
        with contextlib.redirect_stdout(text):
            evaluate(
                build,
                folder,
                ["7dof-hit"],
                n_episodes=count,
                n_cores=1,
                seed=seed,
                interpolation_order=None,
            )
        (file,) = Path(folder).rglob("violations.json")
        violations = json.loads(file.read_text())["violation summary"]
    values = dict(
        line.split(":") for line in text.getvalue().splitlines() if line.count(":") == 1
    )
    total["episodes"] += count
    total["successes"] += round(float(values["Success"]) * count)
    total["penalty"] += float(values["Penalty"])
    for name, number in violations.items():
        total["violations"][name] = total["violations"].get(name, 0) + number


if __name__ == "__main__":
    raise SystemExit(main())
