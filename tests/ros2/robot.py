"""A robot for `fpmcl live --ros2`: one process plays clouds, another receives what the program publishes, by Cyclone DDS.

usage: robot.py play FOLDER SCENARIO -- PROGRAM ARGUMENTS...     runs the program on scans of FOLDER, and prints JSON
       robot.py receive                                          prints what is received, a line each

It runs only where the loopback is the only network interface, because DDS announces itself on every one.
"""

import json
import math
import pathlib
import signal
import subprocess
import sys
import tempfile
import threading
import time
from array import array as array_of
from dataclasses import dataclass

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, byte, float64, int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration


def ros(package, name):
    return {"typename": f"{package}.msg.dds_.{name}_"}


@dataclass
class Time(IdlStruct, **ros("builtin_interfaces", "Time")):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, **ros("std_msgs", "Header")):
    stamp: Time
    frame_id: str


@dataclass
class PointField(IdlStruct, **ros("sensor_msgs", "PointField")):
    name: str
    offset: uint32
    datatype: uint8
    count: uint32


@dataclass
class PointCloud2(IdlStruct, **ros("sensor_msgs", "PointCloud2")):
    header: Header
    height: uint32
    width: uint32
    fields: sequence[PointField]
    is_bigendian: bool
    point_step: uint32
    row_step: uint32
    data: sequence[uint8]
    is_dense: bool


@dataclass
class Garbage(IdlStruct, **ros("sensor_msgs", "PointCloud2")):
    data: sequence[uint8]


@dataclass
class LaserScan(IdlStruct, **ros("sensor_msgs", "LaserScan")):
    data: sequence[uint8]


@dataclass
class Vector3(IdlStruct, **ros("geometry_msgs", "Vector3")):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, **ros("geometry_msgs", "Quaternion")):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Pose(IdlStruct, **ros("geometry_msgs", "Pose")):
    position: Vector3
    orientation: Quaternion


@dataclass
class PoseWithCovariance(IdlStruct, **ros("geometry_msgs", "PoseWithCovariance")):
    pose: Pose
    covariance: array[float64, 36]


@dataclass
class PoseWithCovarianceStamped(IdlStruct, **ros("geometry_msgs", "PoseWithCovarianceStamped")):
    header: Header
    pose: PoseWithCovariance


@dataclass
class Twist(IdlStruct, **ros("geometry_msgs", "Twist")):
    linear: Vector3
    angular: Vector3


@dataclass
class TwistWithCovariance(IdlStruct, **ros("geometry_msgs", "TwistWithCovariance")):
    twist: Twist
    covariance: array[float64, 36]


@dataclass
class Odometry(IdlStruct, **ros("nav_msgs", "Odometry")):
    header: Header
    child_frame_id: str
    pose: PoseWithCovariance
    twist: TwistWithCovariance


@dataclass
class TransformStamped(IdlStruct, **ros("geometry_msgs", "TransformStamped")):
    header: Header
    child_frame_id: str
    transform: Pose


@dataclass
class TFMessage(IdlStruct, **ros("tf2_msgs", "TFMessage")):
    transforms: sequence[TransformStamped]


@dataclass
class KeyValue(IdlStruct, **ros("diagnostic_msgs", "KeyValue")):
    key: str
    value: str


@dataclass
class DiagnosticStatus(IdlStruct, **ros("diagnostic_msgs", "DiagnosticStatus")):
    level: byte
    name: str
    message: str
    hardware_id: str
    values: sequence[KeyValue]


@dataclass
class DiagnosticArray(IdlStruct, **ros("diagnostic_msgs", "DiagnosticArray")):
    header: Header
    status: sequence[DiagnosticStatus]


RELIABLE = Policy.Reliability.Reliable(duration(seconds=1))
LATCHED = Qos(RELIABLE, Policy.Durability.TransientLocal, Policy.History.KeepLast(1))
# Those of subscriptions of ROS 2.
USUAL = Qos(RELIABLE, Policy.Durability.Volatile, Policy.History.KeepLast(1000))
# That of drivers of sensors.
OF_SENSORS = Qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, Policy.History.KeepLast(5))


def writer(participant, topic, message, qos):
    return DataWriter(participant, Topic(participant, "rt" + topic, message, qos=qos), qos=qos)


def reader(participant, topic, message, qos):
    return DataReader(participant, Topic(participant, "rt" + topic, message, qos=qos), qos=qos)


def stamp(time_ns):
    return Time(time_ns // 10**9, time_ns % 10**9)


def numbers(pose):
    return [*vars(pose.position).values(), *vars(pose.orientation).values()]


def described(topic, message):
    """What the test looks at."""
    if topic == "/tf":
        return [
            {
                "parent": it.header.frame_id,
                "child": it.child_frame_id,
                "stamp_ns": it.header.stamp.sec * 10**9 + it.header.stamp.nanosec,
                "pose": numbers(it.transform),
            }
            for it in message.transforms
        ]
    if topic == "/diagnostics":
        status = message.status[0]
        values = {it.key: it.value for it in status.values}
        return {"level": status.level, "name": status.name, "message": status.message, "values": values}
    header = {
        "frame": message.header.frame_id,
        "stamp_ns": message.header.stamp.sec * 10**9 + message.header.stamp.nanosec,
    }
    if topic == "/fpmcl/map":
        return header | {"points": message.width, "bytes": len(message.data)}
    found = header | {"pose": numbers(message.pose.pose), "covariance": list(message.pose.covariance)}
    if topic == "/fpmcl/odometry":
        twist = message.twist.twist
        return found | {"child": message.child_frame_id, "forward_m_per_s": twist.linear.x, "turn_rad_per_s": twist.angular.z}
    return found


def receive():
    participant = DomainParticipant(0)
    readers = {
        "/fpmcl/pose": reader(participant, "/fpmcl/pose", PoseWithCovarianceStamped, USUAL),
        "/fpmcl/odometry": reader(participant, "/fpmcl/odometry", Odometry, USUAL),
        "/tf": reader(participant, "/tf", TFMessage, USUAL),
        "/diagnostics": reader(participant, "/diagnostics", DiagnosticArray, USUAL),
        "/fpmcl/map": reader(participant, "/fpmcl/map", PointCloud2, LATCHED),
    }
    while True:
        for topic, of_topic in readers.items():
            # At its end the program takes back what it sent: samples without data.
            for message in filter(lambda it: it.sample_info.valid_data, of_topic.take(100)):
                print(json.dumps([topic, described(topic, message)]), flush=True)
        matched = {topic: it.get_matched_publications() for topic, it in readers.items()}
        print(json.dumps(["matched", matched]), flush=True)
        time.sleep(0.02)


class Receiver:
    """What the other process receives."""

    def __init__(self):
        command = [sys.executable, __file__, "receive"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        self.messages = {}
        self.matched = {}
        threading.Thread(target=self.read, daemon=True).start()

    def read(self):
        for line in self.process.stdout:
            topic, message = json.loads(line)
            if topic == "matched":
                self.matched = message
            else:
                self.messages.setdefault(topic, []).append(message)

    def of(self, topic):
        return self.messages.get(topic, [])

    def wait(self, what, is_there, seconds=120):
        """Waits until something is received."""
        end = time.monotonic() + seconds
        while not is_there():
            if time.monotonic() > end:
                states = [it["message"] for it in self.of("/diagnostics")]
                sys.exit(f"not received in {seconds} s: {what}; states {states[-5:]}")
            time.sleep(0.01)

    def has_state(self, words, after=0):
        return any(words in it["message"] for it in self.of("/diagnostics")[after:])

    def wait_for_state(self, words, after=0):
        self.wait(words, lambda: self.has_state(words, after))
        return len(self.of("/diagnostics"))

    def wait_for_program(self, before):
        """Waits for writers of all topics that the program offers, besides those of before."""
        is_new = lambda topic, of_topic: topic == "/tf" or set(of_topic) - set(before.get(topic, []))
        self.wait("the topics of the program", lambda: self.matched and all(map(is_new, *zip(*self.matched.items()))))

    def has_pose(self, time_ns):
        return any(it["stamp_ns"] == time_ns for it in self.of("/fpmcl/pose"))


class Robot:
    """Plays the scans of a folder: frame k at k tenths of a second after the first."""

    PERIOD_NS = 10**8

    def __init__(self, folder, receiver, quality=OF_SENSORS):
        self.scans = sorted(pathlib.Path(folder).glob("*.bin"))
        self.receiver = receiver
        self.participant = DomainParticipant(0)
        self.clouds = writer(self.participant, "/points", PointCloud2, quality)
        self.proposals = writer(self.participant, "/initialpose", PoseWithCovarianceStamped, USUAL)
        # Transforms, and the odometry.
        self.transforms = writer(self.participant, "/tf", TFMessage, USUAL)
        self.static = writer(self.participant, "/tf_static", TFMessage, LATCHED)
        self.odometry = writer(self.participant, "/odom", Odometry, USUAL)
        receiver.wait_for_program({})
        receiver.wait("the reader of clouds", self.clouds.get_matched_subscriptions)
        receiver.wait("the reader of proposals", self.proposals.get_matched_subscriptions)

    def moment(self, frame, later_ns=0):
        return 10**9 + self.PERIOD_NS * frame + later_ns

    def cloud(self, frame, later_ns=0, cut=0, elsewhere=None):
        """Sends a scan, of which the last bytes may be missing, or which may be that of another place."""
        data = self.scans[frame].read_bytes() if elsewhere is None else elsewhere
        fields = [PointField(name, 4 * k, 7, 1) for k, name in enumerate(["x", "y", "z", "intensity"])]
        count = len(data) // 16
        header = Header(stamp(self.moment(frame, later_ns)), "lidar")
        data = data[: len(data) - cut]
        self.sent = time.monotonic()
        self.clouds.write(PointCloud2(header, 1, count, fields, False, 16, 16 * count, data, True))

    def drive(self, frames, later_ns=0):
        """Sends scans at their pace, and waits for the pose of the last."""
        for frame in frames:
            began = time.monotonic()
            self.before(frame)
            self.cloud(frame, later_ns)
            time.sleep(max(0.0, 0.1 - (time.monotonic() - began)))
        last = self.moment(frames[-1], later_ns)
        self.receiver.wait(f"the pose of frame {frames[-1]}", lambda: self.receiver.has_pose(last))

    def before(self, frame):
        """What else is sent before a scan."""

    def drive_until_found(self, first):
        """Drives from frame 5 to frame 11 and back, standing at both ends, from a tenth of a second on, until a pose of that drive is received."""
        for k in range(120):
            frame = 5 + max(0, min(k % 24, 18 - k % 24, 6))
            moment = first + k
            self.cloud(frame, later_ns=(moment - frame) * self.PERIOD_NS)
            time.sleep(0.1)
            if any(self.receiver.has_pose(self.moment(it)) for it in range(first, moment)):
                return
        sys.exit("not found again")

    def propose(self, x, y, moment_ns):
        """Proposes a pose, as rviz does."""
        covariance = [0.0] * 36
        covariance[0] = covariance[7] = 0.25
        covariance[35] = 0.07
        proposal = PoseWithCovariance(self.pose(x, y), covariance)
        self.proposals.write(PoseWithCovarianceStamped(Header(stamp(moment_ns), "map"), proposal))

    def pose(self, x, y=0.0):
        return Pose(Vector3(x, y, 0.0), Quaternion(0.0, 0.0, 0.0, 1.0))


class Wheeled(Robot):
    """Its lidar is 1 m ahead of the base, whose odometry begins at (2, 0) and has 2 % of the way too much ahead, 1 % sideways."""

    def pose_in_odom(self, frame):
        return self.pose(2.0 + 0.51 * frame, 0.005 * frame)

    def place(self, ahead_m=1.0):
        mounting = TransformStamped(Header(stamp(0), "base_link"), "lidar", self.pose(ahead_m))
        self.static.write(TFMessage([mounting]))
        self.receiver.wait("the reader of transforms", self.transforms.get_matched_subscriptions)

    def before(self, frame):
        # At the moment of the scan, and half a period later: that of the scan is known when it is received.
        for later in [0.0, 0.5]:
            self.turn_wheels(frame + later)

    def turn_wheels(self, frame):
        """Sends transform and odometry of a moment between frames."""
        header = Header(stamp(self.moment(0, int(frame * self.PERIOD_NS))), "odom")
        pose = self.pose_in_odom(frame)
        self.transforms.write(TFMessage([TransformStamped(header, "base_link", pose)]))
        with_covariance = PoseWithCovariance(pose, [0.0] * 36)
        still = TwistWithCovariance(Twist(Vector3(0.0, 0.0, 0.0), Vector3(0.0, 0.0, 0.0)), [0.0] * 36)
        self.odometry.write(Odometry(header, "base_link", with_covariance, still))


def drive(folder, receiver, _program):
    robot = Robot(folder, receiver)
    robot.drive(range(12))


def events(folder, receiver, _program):
    """A damaged cloud, one that is none, a stall, and a pose that is proposed."""
    robot = Robot(folder, receiver)
    robot.drive(range(5))
    robot.cloud(5, cut=1000)
    stranger = DomainParticipant(0)
    garbage = writer(stranger, "/points", Garbage, OF_SENSORS)
    receiver.wait("the reader of garbage", garbage.get_matched_subscriptions)
    # Which of them is the first that the program takes, depends on when it has discovered this writer, too.
    for _ in range(20):
        garbage.write(Garbage(bytes([255]) * 1000))
        time.sleep(0.1)
    seen = receiver.wait_for_state("lost: no scan that can be used arrived for too long")
    later_ns = 2 * 10**9
    robot.drive(range(6, 9), later_ns)
    seen = receiver.wait_for_state("tracking: ", seen)
    robot.propose(4.3, 0.2, robot.moment(8, later_ns))
    seen = receiver.wait_for_state("searching: a pose was proposed", seen)
    # Frames without a confirmed pose have none.
    for frame in (9, 10):
        robot.cloud(frame, later_ns)
        time.sleep(0.1)
    robot.drive([11], later_ns)


def hall(length_m=19.0, width_m=7.0):
    """A scan of 16 beams inside a hall, in the middle of which the sensor turned by 30 degrees."""
    points = []
    for beam in range(16):
        elevation = math.radians(2.0 * beam - 15.0)
        for step in range(600):
            heading = math.radians(0.6 * step)
            x, y, z = math.cos(heading), math.sin(heading), math.tan(elevation)
            floor = -1.7 / z if z < 0.0 else math.inf
            wall = min(0.5 * length_m / max(abs(x), 1e-9), 0.5 * width_m / max(abs(y), 1e-9))
            far = min(floor, wall)
            turned = heading + math.radians(30.0)
            points += [far * math.cos(turned), far * math.sin(turned), far * z, 0.0]
    return array_of("f", points).tobytes()


def kidnapped(folder, receiver, _program):
    """Three seconds elsewhere, then back."""
    robot = Robot(folder, receiver)
    robot.drive(range(5))
    elsewhere = hall()
    for k in range(30):
        robot.cloud(5, later_ns=k * robot.PERIOD_NS, elsewhere=elsewhere)
        time.sleep(0.1)
    receiver.wait_for_state("lost: ")
    robot.drive_until_found(35)
    # Less than half of the scans is localized.
    return [3]


def misled(folder, receiver, program):
    """Poses outside the map and across the street are proposed while it is tracked."""
    robot = Robot(folder, receiver)
    robot.drive(range(4))
    robot.propose(5000.0, 0.0, robot.moment(3))
    receiver.wait("the refusal of a proposal", lambda: "x 5000.0 m, y 0.0 m is outside the mapped area" in program.log_text())
    if receiver.has_state("a pose was proposed"):
        sys.exit("a pose outside the map is taken")
    robot.drive([4])
    seen = receiver.wait_for_state("tracking: ")
    robot.propose(2.0, 4.0, robot.moment(4))
    receiver.wait_for_state("searching: a pose was proposed", seen)
    robot.drive_until_found(5)
    # Depending on when it is found.
    return [0, 3]


def frozen(folder, receiver, _program):
    """The stamps of the driver stand still, and go on."""
    robot = Robot(folder, receiver)
    robot.drive(range(5))
    words = "lost: no scan that can be used arrived for too long"
    for _ in range(600):
        robot.cloud(4)
        time.sleep(0.03)
        if receiver.has_state(words):
            break
    receiver.wait_for_state(words)
    robot.drive(range(5, 12))
    # Depending on how many were left out.
    return [0, 3]


def mistyped(folder, receiver, program):
    """Another sender has another type of message on the topic of the clouds, which then fall silent."""
    stranger = DomainParticipant(0)
    _writer = writer(stranger, "/points", LaserScan, OF_SENSORS)
    robot = Robot(folder, receiver)
    robot.drive(range(3))
    receiver.wait("the other type", lambda: "has arrived on /points" in program.log_text())


def carried(folder, receiver, _program):
    """The clouds stall, and the wheels turn on at the pace of the clock."""
    robot = Wheeled(folder, receiver)
    robot.place()
    robot.drive(range(5))
    is_carried = lambda: sum(it["stamp_ns"] > robot.moment(6) for it in receiver.of("/fpmcl/pose")) >= 3
    while not is_carried() and time.monotonic() < robot.sent + 60:
        robot.turn_wheels(4 + 10 * (time.monotonic() - robot.sent))
        time.sleep(0.01)
    receiver.wait("poses without scans", is_carried, seconds=1)


def reliable(folder, receiver, _program):
    """The program asks for reliable clouds: it hears a sender that is reliable, and not another one."""
    stranger = DomainParticipant(0)
    other = writer(stranger, "/points", PointCloud2, OF_SENSORS)
    # The program offers its reader of proposals after that of clouds.
    proposals = writer(stranger, "/initialpose", PoseWithCovarianceStamped, USUAL)
    robot = Robot(folder, receiver, USUAL)
    receiver.wait("the reader of proposals of the stranger", proposals.get_matched_subscriptions)
    robot.drive(range(12))
    if other.get_matched_subscriptions():
        sys.exit("a sender that is not reliable is heard")


def restarted(folder, receiver, program):
    """The program is killed on the way, and started again where it was."""
    robot = Robot(folder, receiver)
    robot.drive(range(6))
    last = pathlib.Path("live/last_pose.json")
    receiver.wait("the last pose", last.exists)
    readers, writers = set(robot.clouds.get_matched_subscriptions()), receiver.matched
    program.restart(["--start=last", "--force"])
    receiver.wait_for_program(writers)
    receiver.wait("the new reader of clouds", lambda: set(robot.clouds.get_matched_subscriptions()) - readers)
    robot.drive(range(6, 12))


def wheels(folder, receiver, _program):
    robot = Wheeled(folder, receiver)
    robot.place()
    robot.drive(range(12))


class Driven(Wheeled):
    """Its odometry is in a file, and is known until the frame after a scan; the lidar is at the base."""

    def __init__(self, folder, receiver):
        super().__init__(folder, receiver)
        rows = [[float(word) for word in row.split()] for row in pathlib.Path("driven.txt").read_text().splitlines()]
        self.poses = [Pose(Vector3(*row[1:4]), Quaternion(*row[4:])) for row in rows]

    def pose_in_odom(self, frame):
        return self.poses[min(frame, len(self.poses) - 1)]

    def before(self, frame):
        self.turn_wheels(frame + 1)


def driven(folder, receiver, _program):
    """A drive of many scans, with the odometry of a file."""
    robot = Driven(folder, receiver)
    robot.place(ahead_m=0.0)
    robot.turn_wheels(0)
    robot.drive(range(len(robot.scans)))


class Program:
    """The program that is tried."""

    def __init__(self, command):
        self.command = command
        self.log = tempfile.NamedTemporaryFile()
        self.start([])

    def start(self, more):
        self.process = subprocess.Popen([*self.command, *more], stdout=subprocess.PIPE, stderr=self.log, text=True)

    def log_text(self):
        """Its messages so far."""
        return pathlib.Path(self.log.name).read_text()

    def restart(self, more):
        """Kills it, and starts it again with another start and further arguments."""
        self.process.kill()
        self.process.communicate()
        self.command = [it for it in self.command if not it.startswith("--start=")]
        self.start(more)


def play(folder, scenario, command):
    program = Program(command)
    receiver = Receiver()
    try:
        expected = scenario(folder, receiver, program) or [0]
        program.process.send_signal(signal.SIGTERM)
        stdout, _ = program.process.communicate(timeout=120)
    except SystemExit as failed:
        program.process.kill()
        sys.exit(f"{failed}; the program printed: {program.log_text()}")
    finally:
        program.process.kill()
        receiver.process.kill()
    if program.process.returncode not in expected:
        sys.exit(f"the program ends with {program.process.returncode}: {program.log_text()}")
    print(json.dumps({"received": receiver.messages, "report": json.loads(stdout), "stderr": program.log_text()}))


def has_loopback_alone():
    links = subprocess.run(["ip", "-o", "link", "show", "up"], capture_output=True, text=True, check=True).stdout
    return [line.split()[1] for line in links.splitlines()] == ["lo:"]


if __name__ == "__main__":
    if not has_loopback_alone():
        sys.exit("the loopback must be the only network interface")
    if sys.argv[1] == "receive":
        receive()
    folder, scenario = sys.argv[2:4]
    known = [drive, events, kidnapped, misled, frozen, mistyped, carried, reliable, restarted, wheels, driven]
    scenarios = {it.__name__: it for it in known}
    play(folder, scenarios[scenario], sys.argv[5:])
