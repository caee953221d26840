"""Evidence by robot: what the drives of each robot have shown, and how it is merged."""

from __future__ import annotations

import math
import secrets
from collections.abc import Iterable
from operator import attrgetter
from typing import NamedTuple
from zlib import crc32

import numpy as np

from ddqn_planner.experience.places import Float64, Places
from ddqn_planner.experience.prior import FEATURES

# The errors and surprises of so many drives of each robot count.
LAST_DRIVES = 64


class Version(NamedTuple):
    """Which evidence of a robot it is; of two versions, the greater one is newer."""

    drives: int  # how often the evidence has changed, mostly by a drive
    # A random number of the last change: if the same evidence was continued twice, the
    # two continuations differ in it.
    token: int


class RobotEvidence(NamedTuple):
    """What the drives of one robot have shown: all of them, or one drive alone."""

    identity: str  # drawn at random when the robot began: names may be the same
    robot: str  # its name, for people; perhaps empty
    version: Version  # of one drive: that of the robot's evidence after the drive
    driven: float  # seconds
    # The half-lives by which the evidence has faded since the robot's last drive, as
    # other robots drove. Of one drive: those by which all older evidence fades.
    faded: float
    # (FEATURES,): by how much features of other maps raised the log slowness
    prior: Float64
    turns: Float64  # (2,): of all drives, see `sums_of_turns`
    places: Places
    errors: Float64  # (D,): of the last D drives, see `ErrorRange`
    surprises: Float64  # (D,)

    @classmethod
    def new(cls, robot: str, side: float) -> RobotEvidence:
        """Return no evidence, of a robot that has not driven yet.

        `robot` is its name, and `side` that of a place, metres.
        """
        return cls(
            identity=secrets.token_hex(16),
            robot=robot,
            version=Version(0, 0),
            driven=0.0,
            faded=0.0,
            prior=np.zeros(FEATURES),
            places=Places.none(side),
            errors=np.zeros(0),
            surprises=np.zeros(0),
            turns=np.zeros(2),
        )

    @property
    def share(self) -> float:
        """The share of the evidence that has not faded since the last drive."""
        return math.pow(0.5, self.faded)

    def renewed(self) -> RobotEvidence:
        """Return the evidence in a newer version, in which it is to be changed."""
        version = Version(self.version.drives + 1, secrets.randbits(63))
        return self._replace(version=version)

    def faded_by(self, half_lives: float) -> RobotEvidence:
        """Return the evidence after it has faded by so many half-lives more."""
        return self._replace(faded=self.faded + half_lives)

    def with_drive(self, drive: RobotEvidence) -> RobotEvidence:
        """Return the evidence after a drive.

        The result follows to the last bit from the evidence and the drive: so whoever
        receives all drives has the same evidence.
        """
        older = self.faded_by(drive.faded)
        places = [self.places.faded(older.share), drive.places]
        errors = np.append(self.errors, drive.errors)
        surprises = np.append(self.surprises, drive.surprises)
        return self._replace(
            version=drive.version,
            driven=self.driven + drive.driven,
            faded=0.0,
            places=Places.summed(places),
            errors=errors[-LAST_DRIVES:],
            surprises=surprises[-LAST_DRIVES:],
            turns=self.turns * older.share + drive.turns,
        )


class Fleet:
    """The evidence of a robot, and of all robots whose evidence was merged with it.

    Of each robot, the newest evidence counts. So it does not matter in which order,
    over which other robots, and how often evidence was merged.
    """

    def __init__(self, own: RobotEvidence) -> None:
        """Begin with the evidence of the robot whose drives are added."""
        self.own = own
        self._others: dict[str, RobotEvidence] = {}  # by identity

    @property
    def members(self) -> list[RobotEvidence]:
        """The evidence of each robot, in the order of their identities."""
        members = {self.own.identity: self.own, **self._others}
        return [members[identity] for identity in sorted(members)]

    @property
    def state(self) -> int:
        """A checksum, equal for copies of a fleet that have the same evidence."""
        versions = [
            (robot.identity, robot.version, robot.faded) for robot in self.members
        ]
        return crc32(repr((self.own.identity, versions)).encode())

    def places(self) -> Places:
        """Return the sums of what all robots have seen, as far as it has not faded."""
        return Places.summed(
            [robot.places.faded(robot.share) for robot in self.members]
        )

    @property
    def turns(self) -> Float64:
        """The sums over what all robots showed of turns, (2,)."""
        turns = [robot.turns * robot.share for robot in self.members]
        return np.asarray(np.sum(turns, axis=0))

    @property
    def prior(self) -> Float64:
        """The mean prior of the robots that have one, (FEATURES,); else zeros."""
        priors = [robot.prior for robot in self.members if robot.prior.any()]
        return np.asarray(np.mean(priors or [np.zeros(FEATURES)], axis=0))

    def add(self, drive: RobotEvidence) -> None:
        """Add a drive of the own robot. The evidence of all robots fades by it."""
        self.own = self.own.with_drive(drive)
        for identity, robot in self._others.items():
            self._others[identity] = robot.faded_by(drive.faded)

    def merge(self, members: Iterable[RobotEvidence]) -> None:
        """Take the evidence of robots where it is newer than what is here.

        Of the same version, that counts which has faded more.
        """
        age = attrgetter("version", "faded")
        for robot in members:
            if robot.identity == self.own.identity:
                self.own = max(self.own, robot, key=age)
            else:
                present = self._others.get(robot.identity, robot)
                self._others[robot.identity] = max(present, robot, key=age)

    def forget(self) -> None:
        """Forget the evidence of the own robot for ever, and that of others for now.

        Others' evidence returns when it is merged again.
        """
        empty = RobotEvidence.new(self.own.robot, self.own.places.side)
        version = self.own.renewed().version
        self.own = empty._replace(identity=self.own.identity, version=version)
        self._others = {}

    def separate(self, drives: Iterable[RobotEvidence]) -> None:
        """Let the last drives of the own robot be those of another robot.

        Another process has continued the own evidence before these drives were added.
        """
        self.own = RobotEvidence.new(self.own.robot, self.own.places.side)
        for drive in drives:
            self.own = self.own.with_drive(drive)
