"""What this machine sustains, one thread: the yardstick beside the benchmark's figures."""

import ast
import inspect
import textwrap
from collections.abc import Callable
from time import process_time
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numba.core.dispatcher import Dispatcher

MULTIPLY_ADDS = 16
"""In `multiply_add`, per element and pass."""


class Rates(NamedTuple):
    """The fastest of several passes over each loop."""

    ns_per_byte: float
    """Copy loop; a byte read and a byte written count as two."""
    ns_per_operation: float
    """Multiply-add loop, float32; a multiply-add counts as two."""


def measure(working_set: int, passes: int = 30) -> Rates:
    """Time both loops; the copy loop moves as many bytes as the filter does, `working_set`."""
    source = np.ones(working_set // 8, np.float32)
    target = np.zeros_like(source)
    values = np.ones(1024, np.float32)
    repeats = 200
    copying = _fastest(lambda: copy(source, target), passes)
    adding = _fastest(lambda: multiply_add(values, np.float32(0.5), repeats), passes)
    operations = 2 * MULTIPLY_ADDS * len(values) * repeats
    return Rates(1e9 * copying / (2 * source.nbytes), 1e9 * adding / operations)


@njit(cache=True)
def copy(source: np.ndarray, target: np.ndarray) -> None:
    """A copy loop."""
    for i in range(source.size):
        target[i] = source[i]


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def multiply_add(values: np.ndarray, a: np.float32, repeats: int) -> None:
    """Sixteen multiply-adds for each of a few values that stay in the first-level cache."""
    for _ in range(repeats):
        for i in range(values.size):
            x = values[i]
            x = x * a + a
            x = x * a + a
            x = x * a + a
            x = x * a + a
            x = x * a + a
            x = x * a + a
            x = x * a + a
            x = x * a + a
            x = x * a + a
            x = x * a + a
            x = x * a + a
            x = x * a + a
            x = x * a + a
            x = x * a + a
            x = x * a + a
            values[i] = x * a + a


def operations(kernel: Dispatcher) -> int:
    """Additions, multiplications and divisions in the loops of a compiled function's source.

    Those of compiled functions that are called there, and have no loop themselves, count too.
    """
    loops = [node for node in ast.walk(_tree(kernel)) if isinstance(node, ast.For)]
    known = kernel.py_func.__globals__
    return sum(_arithmetic(statement, known) for loop in loops for statement in loop.body)


def _tree(kernel: Dispatcher) -> ast.AST:
    return ast.parse(textwrap.dedent(inspect.getsource(kernel.py_func)))


def _arithmetic(node: ast.AST, known: dict[str, Any]) -> int:
    if isinstance(node, ast.Subscript | ast.For):  # indices, and loops counted on their own
        return 0
    own = int(isinstance(node, ast.BinOp | ast.AugAssign))
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        callee: Any = known.get(node.func.id)
        if hasattr(callee, "py_func"):
            own += _arithmetic(_tree(callee), callee.py_func.__globals__)
    return own + sum(_arithmetic(child, known) for child in ast.iter_child_nodes(node))


def _fastest(run: Callable[[], object], passes: int) -> float:
    run()
    times = []
    for _ in range(passes):
        start = process_time()
        run()
        times.append(process_time() - start)
    return min(times)
