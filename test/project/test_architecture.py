"""The rules of the import contracts that a list of forbidden modules cannot state."""

import ast
import subprocess
import sys
from pathlib import Path

import grimp
from patience import PATIENCE_S

ROOT = Path(__file__).parents[2]
PACKAGES = ("msg_defs", "sim_world", "multi_robot_slam")
EDGE = ("msg_defs.ros", "multi_robot_slam.nodes", "sim_world.robots")
"""The only packages and modules that import ROS."""
CORE = ("multi_robot_slam.filter", "multi_robot_slam.smoothing", "multi_robot_slam.models")
WITHOUT_ROS = """
import importlib, sys

class NoRos:
    def find_spec(self, name, path=None, target=None):
        package = name.split(".")[0]
        if package.startswith(("rclpy", "rcl_")) or package.endswith(("_msgs", "_interfaces")):
            raise ModuleNotFoundError(f"{name}: no ROS here")

sys.meta_path.insert(0, NoRos())
for name in sys.argv[1:]:
    importlib.import_module(name)
"""


def test_core_needs_arrays_and_compiled_loops_alone():
    graph = grimp.build_graph(*PACKAGES, include_external_packages=True, cache_dir=None)
    core = set(CORE).union(*map(graph.find_descendants, CORE))
    linear_algebra = {"scipy", "threadpoolctl"}
    # annotated_types and msg_defs.types declare settings and records; both are data.
    allowed = core | {"numpy", "numba", "annotated_types", "msg_defs.types", *linear_algebra}
    imported = set().union(*(graph.find_modules_directly_imported_by(name) for name in core))
    assert imported - allowed - sys.stdlib_module_names == set()


def test_everything_but_the_edge_imports_without_ros():
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    edge = set(EDGE).union(*map(graph.find_descendants, EDGE))
    modules = sorted(graph.modules - edge)
    result = subprocess.run(
        [sys.executable, "-c", WITHOUT_ROS, *modules],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert result.returncode == 0, result.stderr


MOST_PARAMETERS = 8


def functions():
    """Every function of the packages with the names of its decorators."""
    for package in PACKAGES:
        for file in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.FunctionDef):
                    decorators = [
                        ast.unparse(each).partition("(")[0] for each in node.decorator_list
                    ]
                    yield file.relative_to(ROOT), node, decorators


def test_no_function_has_many_parameters():
    """But for compiled kernels, and for commands, whose parameters are their options."""
    long = []
    for file, node, decorators in functions():
        is_kernel = any(name in ("kernel", "njit") for name in decorators)
        arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        options = ["typer.Option" in ast.unparse(a.annotation) for a in arguments if a.annotation]
        is_command = any(options) or any(name.endswith(".command") for name in decorators)
        own = [a for a in arguments if a.arg not in ("self", "cls")]
        if len(own) > MOST_PARAMETERS and not (is_kernel or is_command):
            long.append(f"{file}: {node.name} has {len(own)}")
    assert long == []


def test_compiled_code_has_one_spelling():
    """`models.compiled.kernel`: with Numba's own decorator, code would outlive edits of callees.

    The yardstick of the machine alone is compiled as it likes.
    """
    others = [
        f"{file}: {node.name}"
        for file, node, decorators in functions()
        if any(name.endswith("jit") for name in decorators) and "studies" not in file.parts
    ]
    assert others == []
