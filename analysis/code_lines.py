"""Count code lines of a package: no blank lines, no comments, no docstrings.

Usage: ``python analysis/code_lines.py [FOLDER]`` (default ``pbrl_ppl``) prints the count of each
subpackage and their sum.
"""

import ast
import io
import sys
import tokenize
from collections import Counter
from pathlib import Path

NOT_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


def docstring_lines(tree: ast.AST) -> set[int]:
    """Return the line numbers of the docstrings of a module, its classes and its functions."""
    lines: set[int] = set()
    for node in ast.walk(tree):
        if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        first = node.body[0] if node.body else None
        if (
            isinstance(first, ast.Expr)
            and isinstance(first.value, ast.Constant)
            and isinstance(first.value.value, str)
        ):
            lines.update(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    return lines


def code_lines(text: str) -> int:
    """Return the number of lines of `text` that hold code."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in NOT_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    return len(lines - docstring_lines(ast.parse(text)))


def main() -> None:
    """Print the code lines of each subpackage."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "pbrl_ppl")
    counts: Counter[str] = Counter()
    for path in sorted(folder.rglob("*.py")):
        inside = path.relative_to(folder)
        counts[inside.parts[0] if len(inside.parts) > 1 else "."] += code_lines(path.read_text())
    for room, count in sorted(counts.items(), key=lambda item: -item[1]):
        print(f"{count:7,} {room}")
    print(f"{sum(counts.values()):7,} {folder}")


if __name__ == "__main__":
    main()
