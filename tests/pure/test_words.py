# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Words of the code: names, pronouns in docstrings, and what makes a line dense."""

import ast
import re
from collections import Counter
from functools import cache
from statistics import median

from tests.conftest import REPOSITORY
from tests.pure.test_docs import FOLDERS

LOOP_VARIABLES = {"one", "other", "another", "found"}
PRONOUNS = {
    "one", "ones", "those", "that", "it", "its", "which", "other", "others", "another", "each",
    "both", "all", "them", "such",
}  # fmt: skip
MAX_PRONOUNS = 0.03  # of the words of docstrings; in ten code bases that read well 0.006 to 0.03
MAX_TEST_NAME = 7  # words

VAGUE_NAMES = {
    "of", "by", "at", "on", "there", "given", "found", "told", "own", "one", "other", "whole",
    "alike", "taken", "rest", "here",
    "beside", "within", "without", "beyond", "ours", "theirs", "able", "gone", "left", "done",
    "made", "kept",
}  # fmt: skip
MAX_VAGUE_NAMES = 2.0  # of 1000 code lines; structlog, crazyflow and synchros2 have 0 to 0.9
MAX_PAIRS = 8.0  # tuple assignments of unlike things; these have 0.1 to 8
MAX_NESTED = 1.0  # comprehensions inside another; these have 0 to 0.5

MAX_FUNCTION = 60  # lines beside the docstring: a page of an editor
MAX_FILE = 600  # lines

COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


@cache
def nodes(folder: str) -> dict[str, list[ast.AST]]:
    """The syntax nodes of each Python file of a folder, by the path of the file."""
    paths = sorted((REPOSITORY / folder).rglob("*.py"))
    return {
        str(path.relative_to(REPOSITORY)): list(ast.walk(ast.parse(path.read_text())))
        for path in paths
    }


def worst_first(counts: dict[str, Counter[str]]) -> str:
    """A line for each file: how many words, and which."""
    by_number = sorted(counts.items(), key=lambda item: (-item[1].total(), item[0]))
    return "\n".join(
        f"{name}: {words.total()}: {', '.join(f'{word} {n}' for word, n in words.most_common())}"
        for name, words in by_number
        if words
    )


def test_loop_variables_are_nouns() -> None:
    counts = {
        name: Counter(loop_variables(tree))
        for folder in FOLDERS
        for name, tree in nodes(folder).items()
    }
    assert not sum(counts.values(), Counter()), worst_first(counts)


def loop_variables(tree: list[ast.AST]) -> list[str]:
    """The variables of loops and comprehensions that are pronouns."""
    targets = [
        node.target for node in tree if isinstance(node, ast.For | ast.AsyncFor | ast.comprehension)
    ]
    names = [
        node.id for target in targets for node in ast.walk(target) if isinstance(node, ast.Name)
    ]
    return [name for name in names if name in LOOP_VARIABLES]


def test_code_reads_aloud() -> None:
    trees = nodes("ros_ws/src")
    texts = [(REPOSITORY / name).read_text() for name in trees]
    lines = sum(
        bool(line.strip()) and not line.strip().startswith("#")
        for text in texts
        for line in text.splitlines()
    )
    vague = {name: Counter(vague_names(tree)) for name, tree in trees.items()}
    pairs = {
        name: Counter("pair" for node in tree if is_pair(node)) for name, tree in trees.items()
    }
    nested = {
        name: Counter("nested" for node in tree if is_nested(node)) for name, tree in trees.items()
    }
    for counts, largest in ((vague, MAX_VAGUE_NAMES), (pairs, MAX_PAIRS), (nested, MAX_NESTED)):
        share = 1000.0 * sum(map(Counter.total, counts.values())) / lines
        assert share <= largest, f"{share:.1f} of 1000 lines\n{worst_first(counts)}"


def vague_names(tree: list[ast.AST]) -> list[str]:
    """The variables and arguments that are prepositions, participles or pronouns."""
    names = [
        node.id for node in tree if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
    ]
    names += [node.arg for node in tree if isinstance(node, ast.arg)]
    return [name for name in names if name in VAGUE_NAMES or name.startswith("of_")]


def is_pair(node: ast.AST) -> bool:
    """Whether an assignment is a, b = x, y."""
    return (
        isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Tuple)
        and isinstance(node.value, ast.Tuple)
    )


def is_nested(node: ast.AST) -> bool:
    """Whether a comprehension has two loops, or another inside."""
    if not isinstance(node, COMPREHENSIONS):
        return False
    return (
        len(node.generators) > 1
        or sum(isinstance(part, COMPREHENSIONS) for part in ast.walk(node)) > 1
    )


def test_functions_and_files_are_short() -> None:
    long = set()
    for name, tree in nodes("ros_ws/src").items():
        short_name = name.split("/", 3)[-1]
        if (REPOSITORY / name).read_text().count("\n") > MAX_FILE:
            long.add(short_name)
        functions = [
            node for node in tree if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        ]
        long |= {
            f"{short_name}:{node.name}" for node in functions if code_lines(node) > MAX_FUNCTION
        }
    assert sorted(long) == []


def code_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """The lines of a function without its docstring."""
    first = function.body[0]
    documented = ast.get_docstring(function) is not None
    return length(function) - (length(first) if documented else 0)


def length(node: ast.stmt) -> int:
    """The lines of a statement."""
    return (node.end_lineno or node.lineno) - node.lineno + 1


def test_docstrings_have_few_pronouns() -> None:
    words = {name: docstring_words(tree) for name, tree in nodes("ros_ws/src").items()}
    pronouns = {
        name: Counter(word for word in of_file if word in PRONOUNS)
        for name, of_file in words.items()
    }
    share = sum(map(Counter.total, pronouns.values())) / sum(map(len, words.values()))
    assert share <= MAX_PRONOUNS, f"{share:.1%} of the words\n{worst_first(pronouns)}"


def docstring_words(tree: list[ast.AST]) -> list[str]:
    """The words of all docstrings of a file, in lower case."""
    docstrings = [ast.get_docstring(node) or "" for node in tree if isinstance(node, DOCUMENTED)]
    return re.findall(r"[a-z']+", " ".join(docstrings).lower())


def test_names_of_tests_are_short() -> None:
    functions = {
        name: [
            node.name
            for node in tree
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
        ]
        for name, tree in nodes("tests").items()
    }
    length = {
        name: [len(function.split("_")) - 1 for function in of_file]
        for name, of_file in functions.items()
    }
    middle = median(words for of_file in length.values() for words in of_file)
    long = {
        name: sum(words > MAX_TEST_NAME for words in of_file) for name, of_file in length.items()
    }
    lines = [
        f"{name}: {n} of {len(functions[name])}"
        for name, n in sorted(long.items(), key=lambda item: -item[1])
        if n
    ]
    assert middle <= MAX_TEST_NAME, f"{middle:g} words in the median\n" + "\n".join(lines)
