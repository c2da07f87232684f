"""Conformance suite for links, as functions that a plug-in's author calls in tests.

    from sierra.testing import links as conformance

    def test_it_is_a_link(tmp_path):
        conformance.check(lambda host: MyLink(host, MyOptions()), MyHost(), tmp_path)

The suite tests a real host, a `Host`, which can have faults: it is cut off, loses its power, gets another key. Each claim is
one function of a `Trial`, and can be called alone. A broken claim raises AssertionError with one line, even if Python runs with
`-O`.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from sierra.errors import Missing
from sierra.runners.links.base import LIMIT, Link, Overdue, Unreachable, UntrustedHost
from sierra.testing.assertions import holds, is_one_line, says_what_its_options_are, wait

WORDS = ("", "a b", " c ", "d\ne", "'f'", '"g"', "$HOME", "`h`", "i\\j", "*", "-k", "!l", "ü", "--")
NAMES = (b"a b", b"-rf", b"it's", b'q"uote', b"two\nlines", b"\xff\xfe", "ü".encode(), b"$HOME", b"*")
SOON_S = 12.0
"""Seconds within which a link with default options must notice that its host is gone, and those for a busy machine."""
SLACK_S = 8.0


class Host(Protocol):
    """A host with sshd, whose user has an empty home folder, and its faults."""

    name: str

    def heal(self) -> None:
        """Remove all faults, and empty the home folder."""

    def radio(self, *, up: bool) -> None:
        """Cut the host off from the network, or connect it again. Neither side is told."""

    def power_cut(self) -> None:
        """Stop the host. Nobody is told."""

    def boot(self) -> None:
        """Start the host again, with the same disk."""

    def fill_disk(self) -> None:
        """Leave less than 100 kB in the home folder."""

    def read_only(self) -> None:
        """Make the home folder read-only."""

    def slow(self) -> None:
        """Limit the network to 1 Mbit/s in both directions."""

    def new_host_key(self) -> None:
        """Change the host's key. The client knows the old one."""

    def forget_host_key(self) -> None:
        """Let the client not know the host's key."""

    def refuse_logins(self) -> None:
        """Refuse the client's key."""

    def only_passwords(self) -> None:
        """Accept logins by a password only."""

    def proxy(self, delay: float) -> contextlib.AbstractContextManager[Proxy]:
        """Put a proxy in the way, which delays everything by some seconds."""


class Proxy(Protocol):
    """A TCP proxy to a host."""

    name: str
    """The name of the host behind the proxy."""

    def stall(self, *, stalled: bool = True) -> None:
        """Pass nothing any more, or go on."""

    def cut(self) -> None:
        """Reset all connections."""


@dataclass
class Trial:
    """A kind of link, and a host to test it with."""

    make: Callable[[str], Link]
    host: Host
    folder: Path
    """A folder for local files."""
    made: list[Link] = field(default_factory=list)

    def link(self, name: str = "") -> Link:
        self.made.append(self.make(name or self.host.name))
        return self.made[-1]

    def close(self) -> None:
        for link in self.made:
            link.close()

    def tree(self, size: int = 100_000) -> Path:
        """Return a new local folder with odd names, an executable file, an empty folder and links."""
        root = self.folder / f"tree-{secrets.token_hex(4)}"
        (root / "deep" / "er").mkdir(parents=True)
        (root / "empty").mkdir()
        for name in NAMES:
            Path(os.fsdecode(os.fsencode(root) + b"/" + name)).write_bytes(name)
        (root / "deep" / "program").write_text("#!/bin/sh\necho executed\n")
        (root / "deep" / "program").chmod(0o755)
        (root / "deep" / "er" / "link").symlink_to("../program")
        (root / "zero").touch()
        (root / "big").write_bytes(secrets.token_bytes(size))
        return root

    @contextlib.contextmanager
    def raises(self, *kinds: type[Missing], within: float = 60.0, what: str) -> Iterator[None]:
        """Check that one of these errors is raised in time, with one line that names the host."""
        began = time.monotonic()
        try:
            yield
        except kinds as error:
            is_one_line(str(error))
            holds(self.host.name in str(error), f"{what}: the error does not name the host: {error}")
        else:
            raise AssertionError(f"{what}: no error was raised")
        took = time.monotonic() - began
        holds(took < within + SLACK_S, f"{what}: the error took {took:.1f} s")

    def executing(self, link: Link, word: str) -> bool:
        """Check whether a command with this word is executing on the host."""
        return link.run(["pgrep", "-f", f"[{word[0]}]{word[1:]}"]).status == 0

    def names(self, link: Link, folder: str = ".") -> list[str]:
        """Return the names in a folder of the host; a shell's dotted files do not count."""
        listed = link.run(["ls", "-A", folder]).stdout.decode(errors="replace").split("\n")[:-1]
        return [name for name in listed if not name.startswith((".bash", ".profile", ".cache", ".ssh"))]


def check(make: Callable[[str], Link], host: Host, folder: Path) -> None:
    """Check all claims. `make` makes a link to a host's name; `folder` is an empty folder for local files."""
    for claim in CLAIMS:
        host.heal()
        call(claim, Trial(make, host, folder))


def call(claim: Callable[[Trial], None], trial: Trial) -> None:
    """Check one claim, and close the links."""
    try:
        claim(trial)
    finally:
        trial.close()


def passes_words_and_bytes_as_they_are(trial: Trial) -> None:
    """Check that no word of a command is evaluated, and that input and output are exact."""
    link = trial.link()
    says_what_its_options_are(link)
    ended = link.run(["printf", "<%s>", *WORDS])
    holds(ended.stdout.decode() == "".join(f"<{word}>" for word in WORDS), f"{WORDS} became {ended.stdout!r}")
    data = bytes(range(256)) * 2000
    ended = link.run(["sh", "-c", "cat; printf error >&2"], stdin=data)
    holds((ended.stdout, ended.stderr) == (data, b"error"), f"input came back as {ended.stdout[:300]!r}, {ended.stderr!r}")
    holds(link.run(["cat"]).stdout == b"", "the input of a command without input is not empty")


def tells_how_commands_end(trial: Trial) -> None:
    """Check that each status is that of the command, also those that clients use themselves."""
    link = trial.link()
    for script, status in (("exit 0", 0), ("exit 3", 3), ("exit 124", 124), ("exit 255", 255), ("kill -9 $$", 137)):
        ended = link.run(["sh", "-c", script])
        holds(ended.status == status, f"{script} became {ended}")
    holds(link.run(["/nonexistent/program"]).status in (126, 127), "a missing program has no status of its own")
    began = time.monotonic()
    holds(link.run(["sh", "-c", "sleep 60 & echo done"]).stdout == b"done\n", "a command with a background process failed")
    holds(time.monotonic() - began < SOON_S, "a command waits for the processes that it left in the background")


def bounds_output(trial: Trial) -> None:
    """Check that much output is read, and only its beginning kept."""
    began = time.monotonic()
    ended = trial.link().run(["sh", "-c", "echo first; head -c 200000000 /dev/zero; exit 5"], timeout=120)
    holds(ended.status == 5 and len(ended.stdout) == LIMIT and ended.stdout.startswith(b"first\n"), "200 MB were not bounded")
    holds(time.monotonic() - began < 60, "200 MB took more than a minute")


def ends_overdue_commands(trial: Trial) -> None:
    """Check that a command without end is reported and ended, again and again, and that the link stays usable."""
    link = trial.link()
    for number in range(12):
        with trial.raises(Overdue, within=1, what="a command without end"):
            link.run(["sleep", f"{5000 + number}"], timeout=0.3)
    holds(link.run(["echo", "there"]).stdout == b"there\n", "the link is not usable after overdue commands")
    wait(lambda: not trial.executing(link, "sleep 50"), lambda: "overdue commands go on", SOON_S)


def executes_many_at_once(trial: Trial) -> None:
    """Check that more commands at once than sshd accepts are all executed, and that a channel goes on beside them."""
    link = trial.link()
    channel = link.channel(["cat"])
    with ThreadPoolExecutor(30) as pool:
        outputs = list(pool.map(lambda number: link.run(["sh", "-c", f"sleep 0.1; echo {number}"]).stdout, range(40)))
    holds(outputs == [b"%d\n" % number for number in range(40)], f"40 commands at once returned {outputs}")
    channel.send("still there")
    holds(channel.receive(SOON_S) == "still there", "a channel was lost")
    channel.close()


def exchanges_lines(trial: Trial) -> None:
    """Check lines in both directions, the end, and that the command's input ends with the channel."""
    link = trial.link()
    channel = link.channel(["sh", "-c", 'echo ready; read a; echo "<$a>"; echo problem >&2; printf rest; exit 4'])
    holds(channel.receive(SOON_S) == "ready", "the first line did not arrive")
    with trial.raises(Overdue, within=1, what="a channel that is silent"):
        channel.receive(0.3)
    channel.send("ü 'x' $y")
    lines = [channel.receive(SOON_S) for _ in range(3)]
    holds(lines == ["<ü 'x' $y>", "rest", None], f"the lines of a channel became {lines}")
    holds((channel.status(), channel.errors()) == (4, "problem\n"), f"its end became {channel.status()}, {channel.errors()!r}")
    with trial.raises(Unreachable, what="a line to a command that has ended"):
        for _ in range(50):
            channel.send("more")
            time.sleep(0.1)
    channel.close()
    left = link.channel(["sh", "-c", "echo ready; cat; echo ended > left"])
    left.receive(SOON_S)
    left.close()
    left.close()
    wait(lambda: "left" in trial.names(link), lambda: "a command's input does not end with its channel", SOON_S)


def copies_folders(trial: Trial) -> None:
    """Check that folders arrive as they are, once, and are the same after the way back."""
    link, tree = trial.link(), trial.tree(3_000_000)
    pushed = link.push(tree, "deep/one")
    holds(link.push(tree, "deep/one") == pushed, "pushing again returns something else")
    holds(link.run(["deep/one/deep/er/link"]).stdout == b"executed\n", "an executable file, or a link to it, arrived otherwise")
    back = trial.folder / "back"
    pulled = link.pull("deep/one", back)
    holds(pulled == pushed == link.pull("deep/one", back), "a folder is not the same after the way back")
    holds((back / "empty").is_dir() and os.access(back / "deep" / "program", os.X_OK), "an empty folder or a mode was lost")
    holds((back / "deep/er/link").readlink() == Path("../program"), "a link was lost")
    for path in tree.iterdir():
        same = path.is_dir() or (back / path.name).read_bytes() == path.read_bytes()
        holds(same, f"{path.name!r} is not the same after the way back")
    holds(trial.names(link, "deep") == ["one"], f"something was left beside the target: {trial.names(link, 'deep')}")
    absolute = link.run(["pwd"]).stdout.decode().strip() + "/two"
    holds(link.push(tree, absolute) == pushed and "two" in trial.names(link), "an absolute target was not written")


def refuses_what_is_not_the_same(trial: Trial) -> None:
    """Check that nothing is overwritten, and that nothing leads outside of a folder."""
    link, tree = trial.link(), trial.tree()
    pushed = link.push(tree, "one")
    link.run(["sh", "-c", "echo more >> one/big; ln -s /etc one/outside; mkfifo one/pipe"])
    with trial.raises(Missing, what="a target with other contents"):
        link.push(tree, "one")
    with trial.raises(Missing, what="a folder that is not there"):
        link.pull("nowhere", trial.folder / "nowhere")
    pulled = link.pull("one", trial.folder / "pulled")
    holds(sorted(pulled.left_out) == ["outside", "pipe"], f"a link and a pipe were not left out: {pulled.left_out}")
    holds({name for name in pushed.files if pushed.files[name] != pulled.files[name]} == {"big"}, "other hashes than expected")
    (tree / "outside").symlink_to("/etc")
    try:
        link.push(tree, "two")
    except Missing as error:
        holds("outside" in str(error), f"the link is not named: {error}")
    else:
        raise AssertionError("a link that leads outside was pushed")
    holds(trial.names(link) == ["one"], f"something was left: {trial.names(link)}")


def connects_again(trial: Trial) -> None:
    """Check that a link can be closed, and used again."""
    link = trial.link()
    link.close()
    for _ in range(2):
        holds(link.run(["echo", "there"]).stdout == b"there\n", "the link is not usable again")
        link.close()
        link.close()


def outlives_a_short_loss(trial: Trial) -> None:
    """Check that commands go on after 3 s without a network."""
    link = trial.link()
    channel = link.channel(["cat"])
    with ThreadPoolExecutor(1) as pool:
        ended = pool.submit(link.run, ["sh", "-c", "sleep 5; echo done"])
        time.sleep(0.5)
        trial.host.radio(up=False)
        channel.send("during")
        time.sleep(3)
        trial.host.radio(up=True)
        holds(ended.result().stdout == b"done\n", "a command was lost")
    holds(channel.receive(SOON_S) == "during", "a line was lost")


def notices_a_lost_host(trial: Trial) -> None:
    """Check that a host that leaves the network is noticed in time, and found again when it returns."""
    link = trial.link()
    channel = link.channel(["sh", "-c", "echo ready; sleep 100"])
    channel.receive(SOON_S)
    with ThreadPoolExecutor(2) as pool:
        command = pool.submit(link.run, ["sleep", "100"], timeout=120)
        lines = pool.submit(channel.receive, 120)
        time.sleep(0.5)
        trial.host.radio(up=False)
        for waiting, what in ((command, "a command without a network"), (lines, "a channel without a network")):
            with trial.raises(Unreachable, within=SOON_S, what=what):
                waiting.result()
    with trial.raises(Unreachable, within=SOON_S, what="a new connection without a network"):
        link.run(["true"])
    trial.host.radio(up=True)
    holds(link.run(["echo", "there"]).stdout == b"there\n", "the host is not found again")


def notices_a_power_cut(trial: Trial) -> None:
    """Check commands and copies while the power is lost: none is taken for complete, and none leaves debris."""
    link, tree = trial.link(), trial.tree(12_000_000)
    link.push(tree, "one")
    pulled = trial.folder / "pulled" / "one"
    pulled.parent.mkdir()
    for what, work in (
        ("a command at a power cut", lambda: link.run(["sleep", "100"], timeout=120)),
        ("a push at a power cut", lambda: link.push(tree, "two")),
        ("a pull at a power cut", lambda: link.pull("one", pulled)),
    ):
        trial.host.slow()
        link.run(["true"])
        timer = threading.Timer(2, trial.host.power_cut)
        timer.start()
        with trial.raises(Unreachable, Overdue, within=SOON_S + 2, what=what):
            work()
        timer.join()
        trial.host.boot()
        link.close()
    holds(not list(pulled.parent.iterdir()), f"a pull left {list(pulled.parent.iterdir())}")
    holds("two" not in trial.names(link), "an incomplete push was taken for complete")
    small = trial.tree(10_000)
    holds(link.push(small, "two").files == link.pull("two", pulled).files, "the copies do not succeed afterwards")
    holds(sorted(trial.names(link)) == ["one", "two"], f"the host has debris: {trial.names(link)}")


def trusts_known_keys_only(trial: Trial) -> None:
    """Check that nothing is executed on a host whose key is changed or unknown."""
    link = trial.link()
    link.run(["true"])
    link.close()
    for fault in (trial.host.new_host_key, trial.host.forget_host_key):
        fault()
        for what in ("first", "second"):
            with trial.raises(UntrustedHost, within=SOON_S, what=f"{fault.__name__}, {what} command"):
                link.run(["touch", "executed"])
        with trial.raises(UntrustedHost, within=SOON_S, what=f"{fault.__name__}, push"):
            link.push(trial.tree(), "pushed")
        trial.host.heal()
    holds(not trial.names(link), "something was sent to a host that is not trusted")


def reports_refused_logins(trial: Trial) -> None:
    """Check that a refused login is an error at once: nobody is asked for a password."""
    for fault in (trial.host.refuse_logins, trial.host.only_passwords):
        fault()
        with trial.raises(Unreachable, within=SOON_S, what=fault.__name__):
            trial.link().run(["true"])
        trial.host.heal()


def reports_disks(trial: Trial) -> None:
    """Check that a full and a read-only disk are errors that leave nothing behind."""
    link, tree = trial.link(), trial.tree(1_000_000)
    for fault, word in ((trial.host.fill_disk, "space"), (trial.host.read_only, "ead-only")):
        fault()
        before = trial.names(link)
        try:
            link.push(tree, "folder/one")
        except Missing as error:
            is_one_line(str(error))
            holds(trial.host.name in str(error) and word in str(error), f"{fault.__name__} became {error}")
        else:
            raise AssertionError(f"{fault.__name__}: a push succeeded")
        left = [name for name in trial.names(link) if name not in (*before, "folder")]
        holds(not left and not trial.names(link, "folder"), f"{fault.__name__}: a push left something")
        trial.host.heal()
        link.close()
    holds("big" in link.push(tree, "folder/one").files, "a push does not succeed afterwards")


def uses_slow_networks(trial: Trial) -> None:
    """Check that copies at 1 Mbit/s are not taken for stuck, and that commands go on beside them."""
    link = trial.link()
    link.run(["true"])
    trial.host.slow()
    tree = trial.tree(600_000)
    with ThreadPoolExecutor(1) as pool:
        pushed = pool.submit(link.push, tree, "one", timeout=3)
        holds(link.run(["echo", "beside"], timeout=60).stdout == b"beside\n", "a command was lost beside a copy")
        files = pushed.result().files
    holds(link.pull("one", trial.folder / "back", timeout=3).files == files, "a copy is not the same")


def lives_with_proxies(trial: Trial) -> None:
    """Check that delays only delay, that a stalled connection is reported, and that a cut one is made again."""
    with trial.host.proxy(0.05) as proxy:
        link, tree = trial.link(proxy.name), trial.tree()
        files = link.push(tree, "one").files
        proxy.stall()
        with trial.raises(Overdue, Unreachable, within=SOON_S, what="a command on a stalled connection"):
            link.run(["true"], timeout=3)
        proxy.stall(stalled=False)
        with ThreadPoolExecutor(1) as pool:
            ended = pool.submit(link.run, ["sleep", "100"], timeout=120)
            time.sleep(2)
            proxy.cut()
            with trial.raises(Unreachable, within=SOON_S, what="a command on a connection that was cut"):
                ended.result()
        holds(link.pull("one", trial.folder / "back").files == files, "the connection was not made again")


COMMAND_CLAIMS: tuple[Callable[[Trial], None], ...] = (
    passes_words_and_bytes_as_they_are,
    tells_how_commands_end,
    exchanges_lines,
    copies_folders,
    refuses_what_is_not_the_same,
    connects_again,
)
"""Claims that need no faults of the host."""
CLAIMS: tuple[Callable[[Trial], None], ...] = (
    *COMMAND_CLAIMS,
    bounds_output,
    ends_overdue_commands,
    executes_many_at_once,
    outlives_a_short_loss,
    notices_a_lost_host,
    notices_a_power_cut,
    trusts_known_keys_only,
    reports_refused_logins,
    reports_disks,
    uses_slow_networks,
    lives_with_proxies,
)
