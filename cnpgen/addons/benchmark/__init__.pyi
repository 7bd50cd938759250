from cnpgen.addons.benchmark.benchmark_planner import (
    BenchmarkPlanner as BenchmarkPlanner,
)
from cnpgen.addons.benchmark.benchmark_planner import Setting as Setting
from cnpgen.addons.benchmark.benchmark_report import (
    save_benchmark_figures as save_benchmark_figures,
)
from cnpgen.addons.benchmark.benchmark_report import (
    save_benchmark_report as save_benchmark_report,
)
from cnpgen.addons.benchmark.pucks import ExecutedPrefix as ExecutedPrefix
from cnpgen.addons.benchmark.pucks import Pucks as Pucks
from cnpgen.addons.benchmark.pucks import ReplanningScenario as ReplanningScenario
from cnpgen.addons.benchmark.result_tables import (
    save_benchmark_tables as save_benchmark_tables,
)
from cnpgen.addons.benchmark.run_record import RunRecord as RunRecord
from cnpgen.addons.benchmark.run_suite import Benchmark as Benchmark
from cnpgen.addons.benchmark.run_suite import run_benchmark as run_benchmark
from cnpgen.addons.benchmark.simulator.executed import Executed as Executed
from cnpgen.addons.benchmark.simulator.plant import Plant as Plant
from cnpgen.addons.benchmark.simulator.simulate import Simulation as Simulation
from cnpgen.addons.benchmark.simulator.simulate import simulate_plans as simulate_plans
from cnpgen.addons.benchmark.suite import SampledProblems as SampledProblems
from cnpgen.addons.benchmark.suite import SceneFileProblems as SceneFileProblems
from cnpgen.addons.benchmark.suite import Suite as Suite
from cnpgen.addons.benchmark.suite import load_suite as load_suite
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory as Trajectory
