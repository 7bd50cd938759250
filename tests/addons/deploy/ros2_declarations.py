"""C++ declarations of ROS 2 interfaces, from the fields of their published definitions."""

import re
from pathlib import Path

PRIMITIVES = {
    "int32": "int32_t",
    "uint32": "uint32_t",
    "float64": "double",
    "string": "std::string",
}
# Types of fields that the example leaves empty: these fields are not declared.
OMITTED = {
    "trajectory_msgs/MultiDOFJointTrajectory",
    "trajectory_msgs/MultiDOFJointTrajectoryPoint",
    "JointComponentTolerance",
}
_PARTS = ("Goal", "Result", "Feedback")


def definitions(text: str) -> dict[str, str]:
    """Return the texts of a file of interfaces by their names, such as package/msg/Name."""
    parts = re.split(r"^== (\S+)$", text, flags=re.M)[1:]
    return dict(zip(parts[::2], parts[1::2], strict=True))


def snake_case(name: str) -> str:
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()


def write_headers(interfaces: dict[str, str], folder: Path) -> None:
    """Write package/kind/name.hpp of every interface, as rosidl names it."""
    for full_name, text in interfaces.items():
        package, kind, name = full_name.split("/")
        target = folder / package / kind / f"{snake_case(name)}.hpp"
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(header(full_name, text, set(interfaces)), encoding="utf-8")


def header(full_name: str, text: str, known: set[str]) -> str:
    """Return the header of one interface; a type that is not known raises ValueError."""
    package, kind, name = full_name.split("/")
    includes: set[str] = set()
    if kind == "msg":
        body = _struct(name, text, package, known, includes)
    else:
        parts = re.split(r"^---$", text, flags=re.M)
        inner = (
            _struct(part, lines, package, known, includes)
            for part, lines in zip(_PARTS, parts, strict=True)
        )
        body = f"struct {name} {{\n{''.join(inner)}}};\n"
    return (
        "#pragma once\n#include <cstdint>\n#include <memory>\n#include <string>\n"
        "#include <vector>\n"
        + "".join(f'#include "{include}"\n' for include in sorted(includes))
        + f"namespace {package}::{kind} {{\n{body}}}\n"
    )


def _struct(
    name: str, text: str, package: str, known: set[str], includes: set[str]
) -> str:
    lines = [
        f"struct {name} {{",
        f"using SharedPtr = std::shared_ptr<{name}>;",
        f"using ConstSharedPtr = std::shared_ptr<const {name}>;",
    ]
    for line in text.splitlines():
        words = line.split("#")[0].split()
        if not words or words[0].removesuffix("[]") in OMITTED:
            continue
        kind = _type(words[0].removesuffix("[]"), package, known, includes)
        if "=" in words:
            lines.append(f"inline static const {kind} {' '.join(words[1:])};")
        else:
            array = words[0].endswith("[]")
            lines.append(f"{f'std::vector<{kind}>' if array else kind} {words[1]}{{}};")
    return "\n".join([*lines, "};", ""])


def _type(written: str, package: str, known: set[str], includes: set[str]) -> str:
    """Return the C++ type of a field, and note the header of a message."""
    if written in PRIMITIVES:
        return PRIMITIVES[written]
    package, _, name = (
        written.rpartition("/") if "/" in written else (package, "", written)
    )
    if f"{package}/msg/{name}" not in known:
        raise ValueError(f"there is no definition of {written}")
    includes.add(f"{package}/msg/{snake_case(name)}.hpp")
    return f"{package}::msg::{name}"
