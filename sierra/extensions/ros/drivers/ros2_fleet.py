"""A run of ROS 2 on several robots: they share one domain, and begin and end together.

Each robot, and a base station without a command of its own, executes `ros_driver.py` as its part of the run. The parts find
each other by SIERRA_ADDRESS_0, SIERRA_ADDRESS_1, …: nobody else is asked, and nothing is sent to all. The domain follows from
SIERRA_EXECUTION. Their watchers publish the state of each part on `/sierra/members`, which new subscribers get too:

- `programs`: the number of programs with nodes that it has started; `awaited`: that of its nodes that the run awaits;
- `ready`: it sees the programs of all parts, and nothing has been added for a while;
- `finished`: its awaited nodes have ended;
- `over`: the time of the run is over; it counts only from the leader;
- `closed`: its nodes have ended, and so has its recording.

The leader is the base station, or else robot 1. It publishes `/sierra/started` when all parts are ready, and ends the run.
"""

from __future__ import annotations

import socket
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sierra.extensions.ros.drivers.ros_driver import Failure, given_variable, number_of
else:
    from ros_driver import Failure, given_variable, number_of

HERE = "127.0.0.1"
TRANSPORT = """\
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <transport_descriptors>
    <transport_descriptor>
      <transport_id>own</transport_id>
      <type>UDPv4</type>
      <receiveBufferSize>4194304</receiveBufferSize>
      {interface}
      <maxInitialPeersRange>100</maxInitialPeersRange>
    </transport_descriptor>
  </transport_descriptors>
  <participant profile_name="sierra" is_default_profile="true">
    <rtps>
      <userTransports><transport_id>own</transport_id></userTransports>
      <useBuiltinTransports>false</useBuiltinTransports>
      <builtin>
        <metatrafficUnicastLocatorList><locator/></metatrafficUnicastLocatorList>
        <initialPeersList>{peers}</initialPeersList>
      </builtin>
    </rtps>
  </participant>
</profiles>
"""  # Fast DDS over UDP, with up to 100 programs on each computer; it discovers by unicast, and only at these addresses


def profile(addresses: list[str]) -> str:
    """Return a profile of Fast DDS with which programs find each other at these addresses."""
    peers = "".join(f"<locator><udpv4><address>{address}</address></udpv4></locator>" for address in addresses)
    interface = f"<interfaceWhiteList><address>{HERE}</address></interfaceWhiteList>" if addresses == [HERE] else ""
    return TRANSPORT.format(interface=interface, peers=peers)


def numeric(address: str) -> str:
    """Return an address as numbers. Raises Failure if it is none of IPv4."""
    try:
        return str(socket.getaddrinfo(address, None, socket.AF_INET, socket.SOCK_DGRAM)[0][4][0])
    except OSError as error:
        raise Failure(f"{address} is no address of IPv4; give the robot another address in [runners.robots.fleet]") from error


def fleet(variables: Mapping[str, str], *, has_base: bool) -> Fleet | None:
    """Return the part of this robot in its run; None if the run has no other. Raises Failure."""
    return None if not has_base and variables.get("SIERRA_ROBOTS") == "1" else Fleet(variables, has_base=has_base)


class Fleet:
    """The part of a robot, or of the base station, and what it knows of the others."""

    def __init__(self, variables: Mapping[str, str], *, has_base: bool) -> None:
        """`variables` are those that SIERRA gives to programs on robots. Raises Failure."""
        self.run, self.place = given_variable("SIERRA_EXECUTION", variables), int(given_variable("SIERRA_ROBOT", variables))
        self.places = list(range(0 if has_base else 1, int(given_variable("SIERRA_ROBOTS", variables)) + 1))
        self.addresses = [numeric(given_variable(f"SIERRA_ADDRESS_{place}", variables)) for place in self.places]
        inner = [address for address in self.addresses if address.startswith("127.")]
        if inner and len(self.addresses) > len(inner):
            raise Failure(f"other robots cannot reach {inner[0]}; give it another address in [runners.robots.fleet]")
        self.has_base = has_base
        self.number = number_of(self.run)
        self.state: dict[str, Any] = {"programs": 0, "awaited": 0}
        self.state.update(ready=False, finished=False, over=False, closed=False)
        """The state of this part."""
        self.states: dict[int, dict[str, Any]] = {}
        """The states that all parts have told, with that of this one, by place."""

    @property
    def leads(self) -> bool:
        """Return whether this part tells when the run begins and ends."""
        return self.place == self.places[0]

    @property
    def records(self) -> bool:
        """Return whether this part records topics: the base station does, and all robots if there is none."""
        return not self.has_base or self.place == 0

    def hear(self, members: list[dict[str, Any]]) -> None:
        """Take the states that were published. Raises Failure if one is that of another run."""
        for member in members:
            if member["run"] != self.run:
                raise Failure(f"another run, {member['run'][:10]}, uses the same domain of ROS 2 on these robots")
            self.states[member["place"]] = member["state"]

    def absent(self) -> str:
        """Return the first part of which nothing was heard, in words; nothing if all are there."""
        return next((self.name(place) for place in self.places if place not in self.states), "")

    def unready(self) -> str:
        """Return the first part that is not ready, in words; nothing if all are."""
        return self.absent() or next((self.name(place) for place in self.places if not self.states[place]["ready"]), "")

    def unfinished(self) -> list[str]:
        """Return the parts whose awaited nodes have not ended, in words."""
        return [self.name(place) for place in self.places if not self.states.get(place, {}).get("finished")]

    @property
    def programs(self) -> int:
        """Return the number of programs with nodes of all parts."""
        return sum(state["programs"] for state in self.states.values())

    @property
    def awaited(self) -> int:
        """Return the number of awaited nodes of all parts."""
        return sum(state["awaited"] for state in self.states.values())

    @property
    def is_over(self) -> bool:
        """Return whether the leader has ended the run."""
        return bool(self.states.get(self.places[0], {}).get("over"))

    def unclosed(self) -> str:
        """Return another part that has not ended its nodes, in words; nothing if all have."""
        others = (place for place in self.places if place != self.place)
        return next((self.name(place) for place in others if not self.states.get(place, {}).get("closed")), "")

    @staticmethod
    def name(place: int) -> str:
        return f"robot {place}" if place else "the base station"
