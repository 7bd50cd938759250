"""Check this machine.

The report on stdout has all results, warnings and problems with their remedies;
problems are also printed on stderr. The exit code is 3 if a required library does not
work. 'cnpgen docs troubleshooting' has more remedies.
"""

import argparse
import sys
from typing import TYPE_CHECKING

from cnpgen.cli.parser import Parser, add_json
from cnpgen.cli.terminal import table
from cnpgen.errors import MachineError, counted

if TYPE_CHECKING:
    from cnpgen.validate.machine import MachineReport


def add_options(parser: Parser) -> None:
    add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    import json

    from cnpgen.validate.machine import check_machine

    report = check_machine()
    print(
        json.dumps(report.to_dict(), indent=2)
        if arguments.json
        else machine_text(report)
    )
    for problem in report.problems:
        print(f"cnpgen: error: {problem}", file=sys.stderr)
    return 0 if report.ok else MachineError.exit_code


def machine_text(report: "MachineReport") -> str:
    """Lay out a report for people."""
    libraries = ", ".join(
        f"{name} {version}" for name, version in report.libraries.items()
    )
    settings = ", ".join(
        f"{name}={value}" for name, value in report.environment.items()
    )
    facts = {
        "cnpgen": report.cnpgen,
        "python": f"{report.python}, {report.executable}",
        "platform": report.platform,
        "cores": f"{report.cores} available of {report.cores_present}, vector instructions: {report.vector}",
        "libraries": libraries,
        "HDF5": report.hdf5,
        "variables": settings or "no variable that changes cnpgen is set",
        "code generator": report.generator or "none",
        "handwritten C": report.handwritten,
        "compiler": report.compiler or "none",
        "backend": f"{report.backend or 'none'}: {report.backend_reason}",
        "cache": f"{report.cache_folder} ({_cache(report)})",
        "plug-ins": ", ".join(report.plugins) or "none",
        "recipes": report.recipes,
        "free disk": f"{report.free_bytes / 1e9:,.1f} GB here",
        "verdict": _verdict(report),
    }
    findings = [("problem", problem) for problem in report.problems] + [
        ("warning", note) for note in report.notes
    ]
    return "\n".join(table([*facts.items(), *findings]))


def _cache(report: "MachineReport") -> str:
    if report.cache_writable:
        return "writable"
    return "only read" if report.cache_used else "not used"


def _verdict(report: "MachineReport") -> str:
    if not report.ok:
        return f"cnpgen does not work here: {counted(len(report.problems), 'problem')}, below"
    text = "all requirements are met"
    return (
        f"{text}; {counted(len(report.notes), 'warning')}, below"
        if report.notes
        else text
    )
