"""Files of the repository that services read: workflows, forms, hooks and the citation."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
SCHEMAS = {
    "vendor.github-workflows": ".github/workflows/*.yml",
    "vendor.github-issue-forms": ".github/ISSUE_TEMPLATE/[bf]*.yml",
    "vendor.github-issue-config": ".github/ISSUE_TEMPLATE/config.yml",
    "vendor.citation-file-format": "CITATION.cff",
}
pytestmark = pytest.mark.skipif(not WORKFLOWS, reason="a source archive has none")


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.name)
def test_actions_are_pinned_and_a_workflow_reads_only(workflow: Path) -> None:
    text = workflow.read_text(encoding="utf-8")
    actions = re.findall(r"uses: *(\S+)(.*)", text)
    assert actions
    for action, comment in actions:
        assert re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40}", action), action
        assert re.fullmatch(r" # v\d+\.\d+\.\d+", comment), action
    assert "\npermissions:\n  contents: read\n\n" in text


def test_workflows_run_parts_of_the_script_of_checks() -> None:
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    parts = set(re.findall(r"^  (\w+)\) ;;", script, re.MULTILINE))
    named = {
        part
        for workflow in WORKFLOWS
        for words in re.findall(
            r"run: bash \.ci/run ([\w ]+)", workflow.read_text("utf-8")
        )
        for part in words.split()
    }
    assert named
    assert named <= parts


def test_workflows_test_every_supported_version_of_python() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    first = int(project["requires-python"].removeprefix(">=3."))
    text = (ROOT / ".github" / "workflows" / "tests.yml").read_text(encoding="utf-8")
    versions = re.findall(r'"3\.(\d+)"', text.split("python: [")[1].split("]")[0])
    assert versions == [str(minor) for minor in range(first, first + len(versions))]


@pytest.mark.parametrize("schema", SCHEMAS)
def test_files_have_the_structure_that_services_expect(schema: str) -> None:
    pytest.importorskip("check_jsonschema")
    files = sorted(ROOT.glob(SCHEMAS[schema]))
    assert files
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", schema]
    done = subprocess.run(
        [*command, *map(str, files)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_hooks_are_local_and_installed_by_the_extra_of_developers() -> None:
    yaml = pytest.importorskip("yaml")
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text("utf-8"))
    assert [repository["repo"] for repository in hooks["repos"]] == ["local"]
    entries = [hook["entry"].split()[0] for hook in hooks["repos"][0]["hooks"]]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extra = " ".join(project["optional-dependencies"]["dev"])
    assert all(entry in {"python"} or entry in extra for entry in entries), entries


def test_constraints_satisfy_the_declared_requirements() -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = dict(line.split("==") for line in lines if not line.startswith("#"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    for requirement in project["dependencies"]:
        name, least = requirement.split(">=")
        numbers = [[int(n) for n in v.split(".")[:2]] for v in (pinned[name], least)]
        assert numbers[0] >= [*numbers[1], 0][:2], requirement
