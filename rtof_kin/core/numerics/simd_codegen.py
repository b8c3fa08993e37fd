"""C code with SIMD vectors for CasADi's SX functions: the same expressions, one frame per vector element.

The instructions are split into pieces, one C function each. Values that a later piece needs are kept in an array of
vectors; inputs and constants are read again.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import casadi as ca

from rtof_kin.core.numerics.simd import GROUP, FrameFunction, c_name

_PIECE = 150  #: Instructions per C function; compilation time grows faster than linearly with it
_OPERATIONS = {
    ca.OP_ASSIGN: "{0}",
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "{0} + {0}",
    ca.OP_INV: "1.0 / {0}",
    ca.OP_LT: "one({0} < {1})",
    ca.OP_LE: "one({0} <= {1})",
    ca.OP_EQ: "one({0} == {1})",
    ca.OP_NE: "one({0} != {1})",
    ca.OP_NOT: "one({0} == 0)",
    ca.OP_AND: "one(({0} != 0) & ({1} != 0))",
    ca.OP_OR: "one(({0} != 0) | ({1} != 0))",
    ca.OP_IF_ELSE_ZERO: "where({0} != 0, {1})",
    ca.OP_FMIN: "either({0} < {1}, {0}, {1})",
    ca.OP_FMAX: "either({0} > {1}, {0}, {1})",
    ca.OP_FABS: "either({0} < 0, -{0}, {0})",
    ca.OP_SIGN: "one({0} > 0) - one({0} < 0)",
    ca.OP_SQRT: "each_sqrt({0})",
    ca.OP_FLOOR: "each_floor({0})",
    ca.OP_LOG: "each_log({0})",
    ca.OP_SIN: "each_sin({0})",
    ca.OP_COS: "each_cos({0})",
    ca.OP_ATAN2: "each_atan2({0}, {1})",
}
_HEAD = Path(__file__).with_name("simd.h").read_text(encoding="utf-8")
_DRIVER = """
void {name}(const double *const *in, double *const *out, const long long *place, double *spare,
            long long width, long long step, long long count) {{
  V w[{slots}];
  Now now = {{in, out, width, 0, {{0}}, place, {{0}}}};
  for (; now.frame < count; now.frame += LANES) {{
    for (int l = 0; l < LANES; l++) {{
      const int live = now.frame + l < count;
      now.live[l] = -live;
      now.row[l] = live ? out[{last}] + (now.frame + l) * step : spare;
    }}
    {calls}
  }}
}}
"""
_PIECE_OF = "static __attribute__((noinline)) void {name}(const Now *now, V *w) {{\n{body}\n}}"


def source(functions: Sequence[FrameFunction]) -> str:
    """Return the C source of functions over frames, named by `c_name`."""
    return "\n".join([_HEAD, *(_Writer(given).text() for given in functions)])


def identity(functions: Sequence[FrameFunction]) -> str:
    """Return text that identifies the source of functions. functions: as for `source`."""
    made_of = "".join(f"{g.expression.serialize()} {g.shared} {g.placed}" for g in functions)
    return f"{_HEAD} {_DRIVER} {_PIECE} {_OPERATIONS} {made_of}"


class _Writer:
    """Writer of one function, piece by piece."""

    def __init__(self, given: FrameFunction) -> None:
        self._given, self._function = given, given.expression
        self._lines: list[str] = []
        self._used: list[list[int]] = []
        self._again: set[int] = set()
        self._read()

    def _read(self) -> None:
        """Read the instructions in static single assignment: v<k> is the value of line k."""
        f, now, waiting = self._function, dict[int, int](), list[int]()
        for k in range(f.n_instructions()):
            operation, of = f.instruction_id(k), f.instruction_input(k)
            to = f.instruction_output(k)
            if operation == ca.OP_OUTPUT:
                self._output(to, now[of[0]], waiting)
                continue
            used, line = list[int](), len(self._lines)
            if operation == ca.OP_CONST:
                right = f"(V){{}} + {float(f.instruction_constant(k))!r}"
                self._again.add(line)
            elif operation == ca.OP_INPUT:
                right = f"{'ALIKE' if of[0] in self._given.shared else 'GET'}({of[0]}, {of[1]})"
                self._again.add(line)
            else:
                used = [now[i] for i in of]
                if operation not in _OPERATIONS:
                    raise RuntimeError(f"{f.name()}: no C is known for CasADi's operation {operation}")
                right = _OPERATIONS[operation].format(*(f"v{value}" for value in used))
            now[to[0]] = line
            self._add(f"const V v{line} = {right};", used)

    def _output(self, to: list[int], value: int, waiting: list[int]) -> None:
        if not (self._given.placed and to[0] == self._function.n_out() - 1):
            self._add(f"PUT({to[0]}, {to[1]}, v{value});", [value])
            return
        waiting.append(value)
        if len(waiting) == GROUP:
            values = ", ".join(f"v{v}" for v in waiting)
            self._add(
                f"{{ const V all[] = {{{values}}}; put_group(now, now->place[{to[1] // GROUP}], all); }}", list(waiting)
            )
            waiting.clear()

    def _add(self, line: str, used: list[int]) -> None:
        self._lines.append(line)
        self._used.append(used)

    def text(self) -> str:
        """Return the C source; values that a later piece needs are kept in free places of w."""
        name, count = c_name(self._given.name), len(self._lines)
        last = {value: k // _PIECE for k, used in enumerate(self._used) for value in used}
        slots, free, place = 0, list[int](), dict[int, int]()
        ending: dict[int, list[int]] = {}
        pieces = []
        for piece in range((count + _PIECE - 1) // _PIECE):
            own = range(piece * _PIECE, min(count, (piece + 1) * _PIECE))
            needed = sorted({v for k in own for v in self._used[k] if v < own.start})
            lines = [self._lines[v] if v in self._again else f"const V v{v} = w[{place[v]}];" for v in needed]
            lines += self._lines[own.start : own.stop]
            free += [place[v] for v in ending.get(piece, [])]
            for k in own:
                if last.get(k, piece) > piece and k not in self._again:
                    if not free:
                        free, slots = [slots], slots + 1
                    place[k] = free.pop()
                    ending.setdefault(last[k], []).append(k)
                    lines.append(f"w[{place[k]}] = v{k};")
            pieces.append(_PIECE_OF.format(name=f"{name}_{piece}", body="\n".join(lines)))
        calls = "\n    ".join(f"{name}_{piece}(&now, w);" for piece in range(len(pieces)))
        driver = _DRIVER.format(name=name, slots=max(slots, 1), last=self._function.n_out() - 1, calls=calls)
        return "\n".join([*pieces, driver])
