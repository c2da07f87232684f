"""Launch files in XML: where settings of a run are in them, and the copies of the group that is one robot.

A setting of SIERRA (`random_seed`, `population_size`, …) is a parameter in ROS 1, in the namespace `/sierra`. ROS 2 has no
parameters that all nodes share: there, it is a variable of the launch file, `$(var sierra_random_seed)`, and a parameter
of each node, `sierra_random_seed`.

The one group of the template becomes a group for each robot. The launch file stays one that ROS reads by itself: a copy gets a
namespace of its own, and values for the arguments that it may use (`$(arg robot)`, in ROS 2 `$(var robot)`).
"""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar, Literal, Protocol
from xml.etree import ElementTree

from sierra.plugin import Add, Change, Set, TemplateError, TemplateView
from sierra.util.lazy_definitions import dataclass
from sierra.util.random_poses import PlanePose, RandomPoses

ROOT = "/launch"
SETTINGS = "sierra"
PLACE = "place"
"""The setting with the place of a robot."""
Shared = Literal["master", "domain"]
"""The master of ROS 1, or the domain of ROS 2, that all robots of a run use."""
KEEPER = '<node pkg="sierra_ros" type="timekeeper" name="sierra_timekeeper" required="true" output="screen"/>'

POSE = ("x", "y", "yaw")
"""The arguments of a group with the pose of its robot."""


class Dialect(Protocol):
    """The launch files of one generation of ROS."""

    argument: ClassVar[str]
    """The tag of the elements that give values to a group."""
    group: ClassVar[str]
    """XPath of the namespaces of the groups in a launch file."""
    unnamed: ClassVar[str]
    """XPath of groups with nodes and without a namespace."""
    of_all: ClassVar[tuple[str, ...]]
    """Elements of a launch file that start nothing. All robots keep them, since each sets parameters before its nodes start."""

    def setting(self, name: str) -> str:
        """Return the XPath of the value of a setting."""

    def settings(self, template: TemplateView, values: Mapping[str, str], why: str) -> Iterator[Change]:
        """Yield the changes that give settings their values, and add those that the template does not have."""

    def namespace(self, group: ElementTree.Element) -> tuple[ElementTree.Element, str] | None:
        """Return the element with the namespace of a group, and the name of its attribute; None without a namespace."""


class Launch1:
    """Launch files of ROS 1 (roslaunch)."""

    argument: ClassVar[str] = "arg"
    group: ClassVar[str] = f"{ROOT}/group[not(@ns='{SETTINGS}')]/@ns"
    unnamed: ClassVar[str] = f"{ROOT}/group[node][not(@ns or @if or @unless)]"
    of_all: ClassVar[tuple[str, ...]] = ("arg", "env", "remap", "param", "rosparam")
    types: ClassVar[Mapping[str, str]] = {"random_seed": "int", "population_size": "int", "place": "int", "length": "double"}

    def setting(self, name: str) -> str:
        return f"{ROOT}/group[@ns='{SETTINGS}']/param[@name='{name}']/@value"

    def settings(self, template: TemplateView, values: Mapping[str, str], why: str) -> Iterator[Change]:
        group = f"{ROOT}/group[@ns='{SETTINGS}']"
        if not template.find(f"{group}/@ns"):
            yield Add(ROOT, f'<group ns="{SETTINGS}"/>', at=0, expect=1, why=why)
        for name, value in values.items():
            kind = self.types.get(name, "str" if name == "output" else "auto")
            if template.find(self.setting(name)):
                yield Set(self.setting(name), value, expect=1, why=why)
            else:
                yield Add(group, f'<param name="{name}" type="{kind}" value="{value}"/>', expect=1, why=why)

    def namespace(self, group: ElementTree.Element) -> tuple[ElementTree.Element, str] | None:
        return (group, "ns") if group.get("ns") not in (None, SETTINGS) else None

    def recorder(self, topics: Sequence[str]) -> str:
        words = f"-O $(env SIERRA_OUTPUT)/run.bag -e {' '.join(topics)}"
        return f'<node pkg="rosbag" type="record" name="sierra_bag" args="{words}" output="screen"/>'


class Launch2:
    """Launch files of ROS 2 (ros2 launch)."""

    argument: ClassVar[str] = "let"
    pushed: ClassVar[tuple[str, ...]] = ("push_ros_namespace", "push-ros-namespace")
    group: ClassVar[str] = f"{ROOT}/group/*[{' or '.join(f'self::{tag}' for tag in pushed)}]/@namespace"
    unnamed: ClassVar[str] = f"{ROOT}/group[node][not({' or '.join((*pushed, '@if', '@unless'))})]"
    of_all: ClassVar[tuple[str, ...]] = ("arg", "let", "set_env", "unset_env", "set_parameter", "set_remap", *pushed)

    def setting(self, name: str) -> str:
        return f"{ROOT}/let[@name='{SETTINGS}_{name}']/@value"

    def settings(self, template: TemplateView, values: Mapping[str, str], why: str) -> Iterator[Change]:
        for name, value in reversed(list(values.items())):
            if template.find(self.setting(name)):
                yield Set(self.setting(name), value, expect=1, why=why)
            else:
                yield Add(ROOT, f'<let name="{SETTINGS}_{name}" value="{value}"/>', at=0, expect=1, why=why)

    def namespace(self, group: ElementTree.Element) -> tuple[ElementTree.Element, str] | None:
        found = next((child for child in group if child.tag in self.pushed), None)
        return None if found is None else (found, "namespace")

    def parameters(self, template: TemplateView, values: Mapping[str, str], why: str) -> Iterator[Change]:
        """Yield the changes that give all nodes parameters, by name. Raises TemplateError if the template gives them others."""
        for name, value in values.items():
            if template.find(f"//set_parameter[@name='{name}']/@name"):
                raise TemplateError(
                    f"the launch file sets the parameter {name} for all nodes, as SIERRA does; remove it, or choose another "
                    "name for the seed by seed_parameter"
                )
            yield Add(ROOT, f'<set_parameter name="{name}" value="{value}"/>', at=0, expect=1, why=why)


@dataclass(frozen=True, slots=True)
class Robots:
    """The robots of a launch file: copies of one group."""

    dialect: Dialect
    namespace: str | None = None
    """The namespace of the group; None: the only group that has one."""
    prefix: str | None = None
    """The beginning of the names of robots; None: the namespace without digits at its end."""
    arguments: tuple[tuple[str, str], ...] = ()
    """Arguments that all copies get."""
    poses: tuple[PlanePose, ...] | RandomPoses = ()
    shared: Shared | None = None
    has_base: bool = False
    """True if a base station takes part, which then starts everything that belongs to no robot."""

    def made(self, document: bytes) -> bytes:
        """Return a launch file with a copy of the group for each robot. Raises TemplateError.

        In a run on robots (with the setting `place`), the launch file of a robot has only its own copy, and that of the base
        station (0) has none, and starts everything else if the robots share a master or a domain. Without a group that stands
        for robots, the document stays as it is.
        """
        root = _parsed(document)
        count, seed, robot = (self._setting(root, name) for name in ("population_size", "random_seed", "place"))
        groups = [group for group in root.findall("group") if self._stands(group)]
        if self.poses and (count is None or (robot is None and len(groups) != 1)):
            raise TemplateError("poses need one group that is one robot, which gets them; set group in [platforms.ros]")
        if count is None:
            if self.shared:
                raise TemplateError(
                    f"the robots share a {self.shared}, but no group of the template is one robot; set group in [platforms.ros]"
                )
            return document
        if not count.isdecimal() or int(count) == 0:
            raise TemplateError(f"population_size is {count!r}; use a whole number of 1 or more")
        if len(groups) != 1:
            if robot is None and len(groups) == int(count):  # all robots are in the template
                return document
            raise TemplateError(
                f"population_size is {count}, but {len(groups)} groups stand for robots; set group in [platforms.ros]"
            )
        at = list(root).index(groups[0])
        if robot is not None:
            *_, pose = (None, *self._poses(int(robot), seed or "0"))
            copies = [self._copy(groups[0], int(robot), pose)] if int(robot) else []
        else:
            copies = [self._copy(groups[0], number, pose) for number, pose in enumerate(self._poses(int(count), seed or "0"))]
        root[at : at + 1] = copies
        if self.shared:
            self._keep_own(root, copies)
        self._check_names(root)
        launch_file: bytes = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
        return launch_file + b"\n"

    def read_poses(self, document: bytes) -> Iterator[PlanePose]:
        """Yield the poses that the copies in a launch file have."""
        for group in _parsed(document).findall("group"):
            given = {one.get("name"): one.get("value", "") for one in group if one.tag == self.dialect.argument}
            if {"robot", "index", *POSE} <= given.keys():
                x, y, yaw = (float(given[name]) for name in POSE)
                yield x, y, yaw

    def check(self, count: int) -> None:
        """Raise TemplateError if so many robots have no poses."""
        list(self._poses(count, "0"))

    def _keep_own(self, root: ElementTree.Element, robots: Sequence[ElementTree.Element]) -> None:
        """Remove what only the base station starts from the launch file of a robot. A master has no place of a single robot.

        Raises TemplateError for what every robot would start in one domain.
        """
        settings = root.findall(f"group[@ns='{SETTINGS}']")
        if robots:
            kept = [child for child in root if child in [*settings, *robots] or child.tag in self.dialect.of_all]
            others = [child.tag for child in root if child not in kept and isinstance(child.tag, str)]
            if others and not self.has_base:
                raise TemplateError(
                    f"{others[0]} is outside the group of the robot, so that each robot of a run would start it in the same "
                    "domain; write it into the group, or let a base station start it: robots.base = {}"
                )
            root[:] = kept
        for group in settings:
            for param in group.findall(f"param[@name='{PLACE}']"):
                group.remove(param)

    def _stands(self, group: ElementTree.Element) -> bool:
        """Return whether a group stands for the robots."""
        found = self.dialect.namespace(group)
        return found is not None and (self.namespace is None or found[0].get(found[1]) == self.namespace)

    def _check_names(self, root: ElementTree.Element) -> None:
        """Raise TemplateError if another group has the namespace of a robot."""
        places = [place for group in root.findall("group") if (place := self.dialect.namespace(group))]
        names = [element.get(attribute) for element, attribute in places]
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise TemplateError(f"another group has the namespace {twice!r} of a robot; rename it, or set prefix")

    def _setting(self, root: ElementTree.Element, name: str) -> str | None:
        path = self.dialect.setting(name).removeprefix(f"{ROOT}/").removesuffix("/@value")
        found = root.find(path)
        return None if found is None else found.get("value")

    def _poses(self, count: int, seed: str) -> Iterator[PlanePose | None]:
        if isinstance(self.poses, RandomPoses):
            yield from self.poses.drawn(seed, count)
        elif self.poses and len(self.poses) < count:
            raise TemplateError(f"poses: there are {len(self.poses)} poses for {count} robots; add poses, or use random_poses")
        else:
            yield from self.poses[:count] or (None,) * count

    def _copy(self, group: ElementTree.Element, number: int, pose: PlanePose | None) -> ElementTree.Element:
        robot = copy.deepcopy(group)
        namespace = self.dialect.namespace(robot)
        assert namespace is not None  # noqa: S101 - the group was found by its namespace
        element, attribute = namespace
        name = f"{self.prefix or re.sub('[0-9]+$', '', element.get(attribute, ''))}{number}"
        element.set(attribute, name)
        values = [("robot", name), ("index", str(number)), *self.arguments]
        values += zip(POSE, map(repr, pose), strict=True) if pose else ()
        for key, value in reversed(values):
            self._give(robot, key, value)
        return robot

    def _give(self, group: ElementTree.Element, name: str, value: str) -> None:
        """Give an argument of a group its value, whether the group declares it or not."""
        tag = self.dialect.argument
        for child in [child for child in group if child.tag == tag and child.get("name") == name]:
            group.remove(child)
        given = ElementTree.Element(tag, {"name": name, "value": value})
        given.tail = group.text
        group.insert(0, given)


def _parsed(document: bytes) -> ElementTree.Element:
    """Return the root of a launch file, with its comments. Raises TemplateError if it is not XML."""
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))  # noqa: S314 - templates refuse entities
    try:
        root: ElementTree.Element = ElementTree.fromstring(document, parser=parser)  # noqa: S314
    except (ElementTree.ParseError, ValueError) as error:
        raise TemplateError(f"the launch file is not XML: {error}") from error
    return root
