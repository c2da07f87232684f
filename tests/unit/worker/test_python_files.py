"""Hashes of files in virtual environments, and the distributions that files belong to."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from sierra.worker.python_files import Distributions, Environments, sha256_of


def environment(folder: Path, name: str, content: str) -> str:
    """Make a virtual environment with one file; return the file's SHA-256."""
    (folder / "bin").mkdir(parents=True)
    (folder / "pyvenv.cfg").touch()
    file = folder / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(content)
    return sha256_of(str(file), Environments())


RECORD = "lib/python3.11/site-packages/x-1.dist-info/RECORD"


SAME = {
    "bin/tool": "#!{0}/bin/python3 -I\nimport tool\n",
    "bin/long": "#!/bin/sh\n'''exec' \"{0}/bin/python3\" \"$0\" \"$@\"\n' '''\n",
    "lib/x.pth": "import x; x.map('{0}')\n",
    "pyvenv.cfg": "home = /usr/bin\nversion = 3.11.2\ncommand = /usr/bin/python3 -m venv {0}\n",
    RECORD: "x.py,sha256=a,1\n../../../bin/x,sha256={0},9\n__pycache__/x.pyc,,\n",
    "lib/other": "#!/usr/bin/python3\n",
}


DIFFERENT = {
    "the interpreter": ("bin/tool", "#!{0}/bin/python3\n", "#!{0}/bin/pypy3\n"),
    "its options": ("bin/tool", "#!{0}/bin/python3\n", "#!{0}/bin/python3 -I\n"),
    "another environment": ("bin/tool", "#!{0}/bin/python3\n", "#!/else/bin/python3\n"),
    "a folder beside it": ("bin/tool", "#!{0}2/bin/python3\n", "#!{0}2/bin/python3\n"),
    "a folder that ends alike": ("bin/tool", "#!/root{0}/python3\n", "#!/root{0}/python3\n"),
    "the words that replace it": ("bin/tool", "#!{0}/bin/python3\n", "#!{{prefix}}/bin/python3\n"),
    "the rest of a script": ("bin/tool", "#!{0}/bin/python3\n1\n", "#!{0}/bin/python3\n2\n"),
    "the base of the environment": ("pyvenv.cfg", "home = /usr/bin\n", "home = /opt/bin\n"),
    "the packages of the system": ("pyvenv.cfg", "home = /x\n", "home = /x\ninclude-system-site-packages = true\n"),
    "a recorded file": (RECORD, "x.py,sha256=a,1\n", "x.py,sha256=b,1\n"),
}


@pytest.mark.parametrize("name", SAME)
def test_the_path_of_a_virtual_environment_does_not_count(tmp_path: Path, name: str) -> None:
    one, two = (environment(tmp_path / place, name, SAME[name].format(tmp_path / place)) for place in ("one", "two/deep"))
    assert one == two


@pytest.mark.parametrize(("name", "one", "two"), DIFFERENT.values(), ids=list(DIFFERENT))
def test_all_else_in_a_virtual_environment_counts(tmp_path: Path, name: str, one: str, two: str) -> None:
    texts = {tmp_path / "one": one, tmp_path / "two": two}
    first, second = (environment(place, name, text.format(place)) for place, text in texts.items())
    assert first != second


BY_PIP = """\
import re
import sys
from tabulate import _main
if __name__ == '__main__':
    sys.argv[0] = re.sub(r'(-script\\.pyw|\\.exe)?$', '', sys.argv[0])
    sys.exit(_main())
"""


BY_NEW_PIP = """\
import sys
from tabulate import _main
if __name__ == '__main__':
    sys.argv[0] = sys.argv[0].removesuffix('.exe')
    sys.exit(_main())
"""


BY_UV = """\
# -*- coding: utf-8 -*-
import sys
from tabulate import _main
if __name__ == "__main__":
    if sys.argv[0].endswith("-script.pyw"):
        sys.argv[0] = sys.argv[0][:-11]
    elif sys.argv[0].endswith(".exe"):
        sys.argv[0] = sys.argv[0][:-4]
    sys.exit(_main())
"""


FILES_OF_TOOLS = {
    "bin/tabulate": (
        f"#!{{0}}/bin/python3\n# -*- coding: utf-8 -*-\n{BY_PIP}",
        f"#!{{0}}/bin/python3.11\n# -*- coding: utf-8 -*-\n{BY_PIP}",
        f"#!{{0}}/bin/python\n{BY_NEW_PIP}",
        f"#!{{0}}/bin/python\n{BY_UV}",
    ),
    "bin/own": ("#!{0}/bin/python3 -s\nprint(1)\n", "#!{0}/bin/python3.11 -s\nprint(1)\n"),
    "pyvenv.cfg": (
        "home = /usr/bin\ninclude-system-site-packages = false\nversion = 3.11.7\ncommand = /usr/bin/python3 -m venv x\n",
        "home = /usr/bin\nimplementation = CPython\nuv = 0.9\nversion_info = 3.11.7\ninclude-system-site-packages = false\n",
    ),
    "lib/six-1.dist-info/RECORD": (
        "six.py,sha256=a,1\nsix-1.dist-info/INSTALLER,sha256=b,4\nsix-1.dist-info/REQUESTED,sha256=c,0\n",
        "six-1.dist-info/INSTALLER,sha256=d,2\nsix.py,sha256=a,1\n",
    ),
}


@pytest.mark.parametrize("name", FILES_OF_TOOLS)
def test_the_tool_that_made_a_virtual_environment_does_not_count(tmp_path: Path, name: str) -> None:
    texts = [text.replace("{0}", str(tmp_path / str(number))) for number, text in enumerate(FILES_OF_TOOLS[name])]
    found = {environment(tmp_path / str(number), name, text) for number, text in enumerate(texts)}
    assert len(found) == 1


def test_other_words_in_a_script_that_calls_a_function_count(tmp_path: Path) -> None:
    first = f"#!{{0}}/bin/python3\n{BY_UV}"
    others = [
        ("_main())", "_main(1))"),
        ("tabulate", "other"),
        ("    sys.exit", "    print(1)\n    sys.exit"),
        ("[:-11]", "[:-11] or evil()"),
        ("python3", "python3 -O"),
    ]
    texts = [first, *(first.replace(*words) for words in others)]
    places = [tmp_path / str(number) for number in range(len(texts))]
    pairs = zip(places, texts, strict=True)
    found = [environment(place, "bin/tool", text.replace("{0}", str(place))) for place, text in pairs]
    assert len(set(found)) == len(found)


def test_a_script_outside_virtual_environments_is_hashed_as_it_is(tmp_path: Path) -> None:
    script = tmp_path / "bin" / "tool"
    script.parent.mkdir()
    script.write_text(f"#!{tmp_path}/bin/python3\n")
    assert sha256_of(str(script), Environments()) == hashlib.sha256(script.read_bytes()).hexdigest()


def test_a_file_belongs_to_the_distribution_that_has_installed_it(tmp_path: Path) -> None:
    site = tmp_path / "lib/python3.11/site-packages"
    (site / "some_thing-1.2.dist-info").mkdir(parents=True)
    (site / "some_thing-1.2.dist-info/RECORD").write_text('thing/a.py,sha256=x,3\n"thing/b,c.py",,\n../../../bin/thing,,\n')
    found = Distributions()
    assert found.of(f"{site}/thing/a.py") == found.of(f"{site}/thing/b,c.py") == "some_thing-1.2"
    assert found.of(f"{site}/other.py") is None
    assert found.of("/usr/lib/x") is None


def test_distributions_that_share_a_folder_are_told_apart_by_their_files(tmp_path: Path) -> None:
    site = tmp_path / "lib/python3.11/site-packages"
    for name in ("one", "two"):
        (site / f"{name}-1.dist-info").mkdir(parents=True)
        (site / f"{name}-1.dist-info/RECORD").write_text(f"shared/{name}.py,sha256=x,3\n")
    found = Distributions()
    assert found.of(f"{site}/shared/one.py") == "one-1"
    assert found.of(f"{site}/shared/two.py") == "two-1"
    assert found.of(f"{site}/shared/three.py") is None


def test_distributions_without_a_record_have_the_modules_that_they_name(tmp_path: Path) -> None:
    site = tmp_path / "dist-packages"
    (site / "PyYAML-6.0.dist-info").mkdir(parents=True)
    (site / "PyYAML-6.0.dist-info/top_level.txt").write_text("_yaml\nyaml\n")
    (site / "JSBSim-1.2-py3.11.egg-info").mkdir()
    found = Distributions()
    assert found.of(f"{site}/yaml/loader.py") == "PyYAML-6.0"
    assert found.of(f"{site}/jsbsim.cpython-311-x86_64-linux-gnu.so") == "JSBSim-1.2"
    sizes = [(f"{site}/yaml/loader.py", 5), (f"{site}/jsbsim.so", 9), (f"{site}/yaml/x.py", 5), ("/usr/lib/x", 99)]
    assert found.used(sizes) == ["pyyaml==6.0", "jsbsim==1.2"]


def test_reading_metadata_is_not_using_a_distribution(tmp_path: Path) -> None:
    site = tmp_path / "site-packages"
    (site / "x-1.dist-info").mkdir(parents=True)
    (site / "x-1.dist-info/RECORD").write_text("x-1.dist-info/METADATA,,\nx.pth,,\nx.py,,\n")
    found = Distributions()
    assert found.used([(f"{site}/x-1.dist-info/METADATA", 9), (f"{site}/x.pth", 9)]) == []
    assert found.used([(f"{site}/x.py", 0)]) == ["x==1"]
