"""A controller as self-contained C: the same generated functions and the same loops that run here, with a QP solver of its own.

What is written: ``NAME.c`` and ``NAME.h``, the controller; ``NAME_replay.c`` and ``replay.txt``, a closed loop recorded here and a
program that replays it and compares; ``CMakeLists.txt``. The C is C99, needs the mathematical library only and allocates nothing.

A solver that can be written as C offers itself by ``parts`` (``Exportable``). What all share is written here: the quadratic
program, the ladder, the recording of the closed loop and the files.
"""

from pgexcite.core.export.parts import Exportable, Input, Parts
from pgexcite.core.export.shooting import nmpc_parts
from pgexcite.core.export.write import Exported, ExportError, export_c

__all__ = ["ExportError", "Exportable", "Exported", "Input", "Parts", "export_c", "nmpc_parts"]
