"""Trial evaluation of XPath expressions that may take for ever, in a separate process with a time limit.

libxml2 evaluates an expression without any limit, and nothing within a process can stop it. Each step that starts from many
nodes and visits many others multiplies the work. So the work is estimated from the number of nodes in the document, and from
the steps that may visit all of them. Nearly all paths need little work and are evaluated at once. An expression that may need
much work is first evaluated by this file as a program. The limit is computing time, so that a busy machine makes no difference.

The program needs only lxml. It reads one line of JSON (path, prefixes, limit in seconds), and then the document.
"""

from __future__ import annotations

import contextlib
import json
import re
import resource
import subprocess
import sys
from collections.abc import Mapping

from lxml import etree

LIMIT_S = 2
"""Seconds of computing time that one expression may take."""
PATIENCE_S = 600
LITTLE = 10**8
"""Number of steps from node to node that take less than a second."""
_LITERAL = re.compile(r"'[^']*'|\"[^\"]*\"")
_WIDE = re.compile(
    r"""// | \.\. | :: | \|                       # all descendants; parents; other axes; a union of node sets
    | (?:[\[(,<>=+*-] | \b(?:and|or|div|mod)\b) \s* /(?!/)  # an absolute path that may be evaluated for each of many nodes
    | (?:!=|[<>]=?|=) (?!\s*(?:''|[0-9.]*[0-9]))  # a comparison of node sets""",
    re.VERBOSE,
)
_PREDICATE = re.compile(r"\[[^\[\]]*\]")
_ended: set[tuple[str, int]] = set()
"""Expressions that ended within the limit, with the number of nodes."""


def ends(path: str, namespaces: Mapping[str, str], root: etree._Element) -> bool:
    """Return True if an expression ends within the limit, for this document and all others of its size."""
    exponent = _exponent(path)
    if exponent < 2:
        return True
    nodes = sum(1 + len(element.attrib) for element in root.iter(etree.Element))
    if nodes**exponent <= LITTLE or (path, nodes) in _ended:
        return True
    if _ends_when_tried(path, namespaces, root):
        _ended.add((path, nodes))
        return True
    return False


def _exponent(path: str) -> int:
    """Return an upper bound for the power of the number of nodes that the work grows with; each predicate adds to it."""
    every = outer = _LITERAL.sub("''", path)
    while (shorter := _PREDICATE.sub("", outer)) != outer:
        outer = shorter
    outside = len(_WIDE.findall(outer))
    return len(_WIDE.findall(every)) - outside + max(1, outside)


def _ends_when_tried(path: str, namespaces: Mapping[str, str], root: etree._Element) -> bool:
    question = json.dumps([path, dict(namespaces), LIMIT_S]).encode()
    document = etree.tostring(root, encoding="utf-8", with_tail=False)
    try:
        ended = subprocess.run(
            [sys.executable, "-I", __file__],
            input=question + b"\n" + document,
            capture_output=True,
            check=False,
            timeout=PATIENCE_S,
        )
    except subprocess.TimeoutExpired:
        return False
    return ended.returncode == 0


def _main() -> None:
    """Evaluate the expression on standard input; the kernel kills the process if it takes too long."""
    path, namespaces, limit = json.loads(sys.stdin.buffer.readline())
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit))
    root = etree.fromstring(sys.stdin.buffer.read(), etree.XMLParser(resolve_entities=False, no_network=True))
    with contextlib.suppress(etree.XPathError, ValueError):  # the same error is reported by the real evaluation
        etree.XPath(path, namespaces=namespaces, regexp=False)(root)


if __name__ == "__main__":
    _main()
