"""Robot logs, written by voxcast and by others: each is read by the other. Called by `run`."""

import io
import json
import math
import subprocess
import sys
import tempfile
from pathlib import Path

import foxglove
import numpy as np
from foxglove.messages import (
    CameraCalibration,
    CompressedImage,
    FrameTransform,
    Quaternion,
    Timestamp,
    Vector3,
)
import foxglove.messages as foxglove_messages
from google.protobuf import descriptor_pb2
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from mcap_ros2.writer import Writer as Ros2Writer
from PIL import Image
from rerun.chunk import McapReader

PROGRAM = Path(sys.argv[1]).resolve()
MODEL = Path("assets/edge.safetensors").resolve()
FRAMES = 3

ROS_TYPES = {
    "Header": ("std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id\n"),
    "Time": ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n"),
    "Vector3": ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n"),
    "Quaternion": ("geometry_msgs/Quaternion", "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"),
    "Transform": (
        "geometry_msgs/Transform",
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    ),
    "TransformStamped": (
        "geometry_msgs/TransformStamped",
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n",
    ),
    "RegionOfInterest": (
        "sensor_msgs/RegionOfInterest",
        "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n",
    ),
}


def definition(text, *names):
    """A ROS 2 message definition with those that it refers to behind it."""
    parts = [text]
    for name in names:
        full, body = ROS_TYPES[name]
        parts.append("=" * 80 + f"\nMSG: {full}\n{body}")
    return "\n".join(parts)


COMPRESSED_IMAGE = definition("std_msgs/Header header\nstring format\nuint8[] data\n", "Header", "Time")
CAMERA_INFO = definition(
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
    "float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n",
    "Header",
    "Time",
    "RegionOfInterest",
)
TF_MESSAGE = definition(
    "geometry_msgs/TransformStamped[] transforms\n",
    "TransformStamped",
    "Header",
    "Time",
    "Transform",
    "Vector3",
    "Quaternion",
)


def voxcast(*arguments):
    done = subprocess.run([PROGRAM, *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == 0, f"{arguments}: {done.stderr}"
    return done.stdout


def run(source, output, *more):
    told = json.loads(voxcast("run", "--model", MODEL, source, "-o", output, "--json", *more))
    return [scene["digest"] for scene in told["scenes"]], told


def messages(path):
    """All messages by topic, decoded with the schemas that the file carries."""
    found = {}
    with open(path, "rb") as file:
        for schema, channel, message, decoded in make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            found.setdefault(channel.topic, []).append((schema.name, message.log_time, decoded))
    return found


def stamp(message):
    return message.timestamp.ToNanoseconds()


def check_written(log, drive, results):
    """Every number of the log against the scenes and the .npz of the same frames."""
    found = messages(log)
    first = json.loads((drive / "000/calibration.json").read_text())["cameras"]
    names = [camera["name"] for camera in first]
    expected = {"/tf", "/voxcast/occupancy", "/voxcast/ground", "/voxcast/status"}
    expected |= {f"/{name}/{what}" for name in names for what in ("image", "calibration")}
    assert set(found) == expected, sorted(set(found) ^ expected)
    for index in range(FRAMES):
        result = np.load(results / f"{index:03}.npz")
        classes, support, bounds = result["classes"], result["support"], result["bounds"]
        name, time, voxels = found["/voxcast/occupancy"][index]
        moment = index * 500_000_000
        assert (name, time, stamp(voxels)) == ("foxglove.VoxelGrid", moment, moment)
        x, y, z = classes.shape
        assert (voxels.column_count, voxels.row_count) == (x, y)
        strides = [voxels.slice_stride, voxels.row_stride, voxels.cell_stride]
        assert strides == [8 * x * y, 8 * x, 8], strides
        cells = np.frombuffer(voxels.data, np.uint8).reshape(z, y, x, 8)
        by_name = {field.name: (field.offset, field.type) for field in voxels.fields}
        assert by_name == {
            "red": (0, 1),
            "green": (1, 1),
            "blue": (2, 1),
            "alpha": (3, 1),
            "class": (4, 1),
            "support": (6, 3),
        }, by_name
        assert np.array_equal(cells[..., 4].transpose(2, 1, 0), classes)
        assert np.array_equal(cells[..., 6:].copy().view("<u2")[..., 0].transpose(2, 1, 0), support)
        assert np.array_equal(cells[..., :3].transpose(2, 1, 0, 3), result["colours"][classes])
        assert np.array_equal(cells[..., 3].transpose(2, 1, 0), np.where(classes == 0, 0, 255))
        low = [voxels.pose.position.x, voxels.pose.position.y, voxels.pose.position.z]
        size = [voxels.cell_size.x, voxels.cell_size.y, voxels.cell_size.z]
        assert np.allclose(low, bounds[:, 0]) and np.allclose(size, (bounds[:, 1] - bounds[:, 0]) / classes.shape)

        _, _, ground = found["/voxcast/ground"][index]
        cells = np.frombuffer(ground.data, np.uint8).reshape(y, x, 12)
        heights = cells[..., 8:].copy().view("<f4")[..., 0].T
        lowest = np.argmax(classes != 0, axis=2)
        occupied = (classes != 0).any(axis=2)
        assert np.array_equal(np.isnan(heights), ~occupied)
        assert np.allclose(heights[occupied], (bounds[2, 0] + (lowest + 0.5) * size[2])[occupied], atol=1e-5)
        assert np.array_equal(cells[..., 4].T, np.take_along_axis(classes, lowest[..., None], 2)[..., 0])

        _, _, status = found["/voxcast/status"][index]
        assert status.latency > 0 and status.occupied == (classes != 0).sum() and len(status.digest) == 16

        scene = json.loads((drive / f"{index:03}/calibration.json").read_text())["cameras"]
        for number, camera in enumerate(scene):
            name, _, image = found[f"/{camera['name']}/image"][index]
            assert (name, stamp(image), image.format) == ("foxglove.CompressedImage", camera["stamp"], "png")
            assert image.data == (drive / f"{index:03}" / camera["file"]).read_bytes()
            _, _, calibration = found[f"/{camera['name']}/calibration"][index]
            _, _, transform = found["/tf"][index * len(scene) + number]
            assert (transform.parent_frame_id, transform.child_frame_id) == ("lidar", camera["name"])
            assert calibration.frame_id == image.frame_id == camera["name"]
            assert (calibration.width, calibration.height) == (camera["width"], camera["height"])
            again = np.array(calibration.K).reshape(3, 3) @ inverse(transform)[:3]
            assert np.allclose(again, np.array(camera["lidar2img"])[:3], rtol=1e-6, atol=1e-6), again
    return found


def matrix(transform):
    q, t = transform.rotation, transform.translation
    w, x, y, z = np.array([q.w, q.x, q.y, q.z]) / math.sqrt(q.w**2 + q.x**2 + q.y**2 + q.z**2)
    out = np.eye(4)
    out[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    out[:3, 3] = [t.x, t.y, t.z]
    return out


def inverse(transform):
    return np.linalg.inv(matrix(transform))


def check_schemas(log):
    """The descriptors in the file against those of Foxglove's own package, field by field."""

    def described(data):
        fields = {}
        for file in descriptor_pb2.FileDescriptorSet.FromString(data).file:
            for message in file.message_type:
                for field in message.field:
                    key = (file.name, file.package, message.name, field.name)
                    fields[key] = (field.number, field.type, field.label, field.type_name)
                for kind in message.enum_type:
                    fields[(message.name, kind.name)] = [(value.name, value.number) for value in kind.value]
        return fields

    with open(log, "rb") as file:
        schemas = make_reader(file).get_summary().schemas.values()
    published = [schema for schema in schemas if schema.name.startswith("foxglove.")]
    assert len(published) == 5, [schema.name for schema in schemas]
    for schema in published:
        theirs = getattr(foxglove_messages, schema.name.removeprefix("foxglove.")).get_schema()
        assert described(schema.data) == described(theirs.data), schema.name


def check_rerun(log, found):
    """What Rerun makes of the log: the voxels in their places and colours, images and cameras."""
    seen, voxels = set(), []
    for chunk in McapReader(log).stream():
        batch = chunk.to_record_batch()
        seen |= {(chunk.entity_path, name) for name in batch.schema.names}
        if chunk.entity_path == "/voxcast/occupancy" and "VoxelGridMap:voxel_indices" in batch.schema.names:
            columns = [batch.column(f"VoxelGridMap:{name}") for name in ("voxel_indices", "colors", "translation")]
            voxels += [[cell[0].as_py() if name == 2 else cell.as_py() for name, cell in enumerate(row)] for row in zip(*columns)]
    assert len(voxels) == FRAMES, len(voxels)
    for (indices, colours, place), (_, _, grid) in zip(voxels, found["/voxcast/occupancy"]):
        cells = np.frombuffer(grid.data, np.uint8).reshape(-1, 8)
        y, x = grid.row_count, grid.column_count
        expected = np.indices((len(cells) // (x * y), y, x)).reshape(3, -1)[::-1].T
        assert np.array_equal(np.array(indices), expected), "x fastest, then y, then z"
        assert np.array_equal(np.array(colours, ">u4").view(np.uint8).reshape(-1, 4), cells[:, :4])
        assert np.allclose(place, [grid.pose.position.x, grid.pose.position.y, grid.pose.position.z])
    for name in (topic.split("/")[1] for topic in found if topic.endswith("/image")):
        assert (f"/{name}/image", "EncodedImage:blob") in seen, sorted(seen)
        assert any(entity == f"/{name}/calibration" and column.startswith("Pinhole:") for entity, column in seen), sorted(seen)


def foxglove_log(path, drive, skip):
    """The drive as Foxglove's own writer writes it, with stamps that are apart; image `skip` is not there."""
    with foxglove.open_mcap(str(path), allow_overwrite=True):
        channels = {}

        def send(topic, message, time):
            kind = type(message).__name__
            if topic not in channels:
                channels[topic] = getattr(foxglove.channels, kind + "Channel")(topic)
            channels[topic].log(message, log_time=time)

        for index in range(FRAMES):
            scene = json.loads((drive / f"{index:03}/calibration.json").read_text())["cameras"]
            for number, camera in enumerate(scene):
                time = camera["stamp"] + number * 3_000_000 + 1_700_000_000_000_000_000
                at = Timestamp(time // 10**9, time % 10**9)
                k, rotation, place = parts(np.array(camera["lidar2img"]))
                send(
                    "/tf",
                    FrameTransform(
                        timestamp=at,
                        parent_frame_id="lidar",
                        child_frame_id=camera["name"],
                        translation=Vector3(x=place[0], y=place[1], z=place[2]),
                        rotation=Quaternion(w=rotation[0], x=rotation[1], y=rotation[2], z=rotation[3]),
                    ),
                    time,
                )
                send(
                    f"/{camera['name']}/camera_info",
                    CameraCalibration(
                        timestamp=at, frame_id=camera["name"], width=camera["width"], height=camera["height"],
                        K=k.flatten().tolist(),
                    ),
                    time,
                )
                if (index, number) != skip:
                    data = (drive / f"{index:03}" / camera["file"]).read_bytes()
                    image = CompressedImage(timestamp=at, frame_id=camera["name"], data=data, format="png")
                    send(f"/{camera['name']}/image_rect_compressed", image, time)


def ros_log(path, drive):
    """The drive as a ROS 2 bag: transforms by way of a vehicle, and rectified JPEGs."""
    with open(path, "wb") as file:
        writer = Ros2Writer(file)
        image = writer.register_msgdef("sensor_msgs/msg/CompressedImage", COMPRESSED_IMAGE)
        info = writer.register_msgdef("sensor_msgs/msg/CameraInfo", CAMERA_INFO)
        transforms = writer.register_msgdef("tf2_msgs/msg/TFMessage", TF_MESSAGE)
        sequence = 0

        def send(topic, schema, message, time):
            nonlocal sequence
            sequence += 1
            writer.write_message(topic, schema, message, log_time=time, publish_time=time, sequence=sequence)

        def header(time, frame):
            return {"stamp": {"sec": time // 10**9, "nanosec": time % 10**9}, "frame_id": frame}

        def transform(time, parent, child, rotation, place):
            w, x, y, z = map(float, rotation)
            return {
                "header": header(time, parent),
                "child_frame_id": child,
                "transform": {
                    "translation": dict(zip("xyz", map(float, place))),
                    "rotation": {"x": x, "y": y, "z": z, "w": w},
                },
            }

        scene = json.loads((drive / "000/calibration.json").read_text())["cameras"]
        fixed = [transform(0, "base_link", "lidar", [1, 0, 0, 0], [1.0, 0.0, 2.0])]
        for camera in scene:
            _, rotation, place = parts(np.array(camera["lidar2img"]))
            fixed.append(transform(0, "base_link", camera["name"], rotation, np.add(place, [1.0, 0.0, 2.0])))
        send("/tf_static", transforms, {"transforms": fixed}, 0)
        for index in range(FRAMES):
            scene = json.loads((drive / f"{index:03}/calibration.json").read_text())["cameras"]
            for camera in scene:
                time = camera["stamp"]
                k, _, _ = parts(np.array(camera["lidar2img"]))
                p = np.hstack([k, np.zeros((3, 1))])
                pixels = Image.open(drive / f"{index:03}" / camera["file"])
                data = io.BytesIO()
                pixels.save(data, "JPEG", quality=95)
                place = f"/sensing/{camera['name'].lower()}"
                send(
                    f"{place}/camera_info",
                    info,
                    {
                        "header": header(time, camera["name"]),
                        "height": camera["height"],
                        "width": camera["width"],
                        "distortion_model": "plumb_bob",
                        # Of the images before they were rectified.
                        "d": [-0.3, 0.1, 0.0, 0.0, 0.0],
                        "k": (k * 1.1).flatten().tolist(),
                        "r": np.eye(3).flatten().tolist(),
                        "p": p.flatten().tolist(),
                        "binning_x": 0,
                        "binning_y": 0,
                        "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
                    },
                    time,
                )
                message = {"header": header(time, camera["name"]), "format": "jpeg", "data": data.getvalue()}
                send(f"{place}/image_rect_color/compressed", image, message, time)
        writer.finish()


def parts(lidar2img):
    """Camera matrix, quaternion (w, x, y, z) and place of a camera, by a decomposition of NumPy's."""
    m = lidar2img[:3, :3]
    flip = np.flipud(np.eye(3))
    q, r = np.linalg.qr((flip @ m).T)
    k, rotation = flip @ r.T @ flip, flip @ q.T
    sign = np.diag(np.sign(np.diag(k)))
    k, rotation = k @ sign, sign @ rotation
    place = -np.linalg.inv(m) @ lidar2img[:3, 3]
    axes = rotation.T
    w = math.sqrt(max(0.0, 1 + np.trace(axes))) / 2
    if w > 1e-6:
        vector = np.array([axes[2, 1] - axes[1, 2], axes[0, 2] - axes[2, 0], axes[1, 0] - axes[0, 1]]) / (4 * w)
    else:
        values, vectors = np.linalg.eigh(axes)
        vector = vectors[:, np.argmax(values)]
    return k, [w, *vector], place


def main():
    with tempfile.TemporaryDirectory() as directory:
        directory = Path(directory)
        drive, log = directory / "drive", directory / "out.mcap"
        voxcast("synth", "--seed", 5, "--frames", FRAMES, "-o", drive)
        expected, _ = run(drive, directory / "results")
        digests, _ = run(drive, log)
        assert digests == expected
        found = check_written(log, drive, directory / "results")
        assert [status.digest for _, _, status in found["/voxcast/status"]] == expected
        print("written: every message is as the scenes and results have it")
        check_schemas(log)
        print("schemas: as Foxglove's")
        check_rerun(log, found)
        print("rerun: opens it")

        replayed, told = run(log, directory / "again.mcap")
        assert replayed == expected and told["log"]["incomplete"] == 0, told["log"]
        assert run(directory / "again.mcap", directory / "third")[0] == expected
        print("replayed: the same digests, twice over")

        whole, lacking = directory / "foxglove.mcap", directory / "lacking.mcap"
        foxglove_log(whole, drive, None)
        digests, told = run(whole, directory / "npz")
        assert digests == expected, (digests, expected)
        assert told["scenes"][1]["stamp"] == 1_700_000_000_507_500_000, told["scenes"]
        foxglove_log(lacking, drive, (1, 2))
        digests, told = run(lacking, directory / "npz")
        assert (digests[0], digests[2]) == (expected[0], expected[2]) and told["scenes"][1]["missing"] == ["CAM_FRONT_LEFT"]
        masked, _ = run(drive / "001", directory / "masked.mcap", "--mask", "CAM_FRONT_LEFT")
        assert digests[1] == masked[0], "a camera without an image is masked"
        print("foxglove's writer: the same digests, a missing image is masked")

        ros = directory / "ros.mcap"
        ros_log(ros, drive)
        order = [f"{camera}=/sensing/{camera.lower()}/image_rect_color/compressed"
                 for camera in (c["name"] for c in json.loads((drive / "000/calibration.json").read_text())["cameras"])]
        named = [word for one in order for word in ("--camera", one)]
        first, told = run(ros, directory / "ros.out.mcap", *named)
        assert first == run(ros, directory / "npz", *named)[0] and told["log"]["frame"] == "lidar"
        # The images are JPEGs, so classes differ somewhat; places must not.
        again = messages(directory / "ros.out.mcap")
        for index in range(FRAMES):
            ours = np.frombuffer(found["/voxcast/occupancy"][index][2].data, np.uint8).reshape(-1, 8)[:, 4]
            theirs = np.frombuffer(again["/voxcast/occupancy"][index][2].data, np.uint8).reshape(-1, 8)[:, 4]
            agreement = (ours == theirs)[(ours | theirs) != 0].mean()
            assert agreement > 0.9, agreement
        for number, name in enumerate(c["name"] for c in json.loads((drive / "000/calibration.json").read_text())["cameras"]):
            ours, theirs = found["/tf"][number][2], again["/tf"][number][2]
            assert np.allclose(matrix(ours), matrix(theirs), atol=1e-6), name
        print("ROS 2 bag: rectified JPEGs by way of a vehicle, twice the same")

        cut = directory / "cut.mcap"
        cut.write_bytes(whole.read_bytes()[: int(whole.stat().st_size * 0.7)])
        digests, told = run(cut, directory / "npz")
        assert digests == expected[: len(digests)] and "cut off" in told["log"]["extent"], told["log"]
        print(f"cut off: {len(digests)} of {FRAMES} frames, {told['log']['extent']}")


main()
