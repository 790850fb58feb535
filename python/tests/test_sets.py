"""Published sets that NumPy writes in small, what the program says of them, and answers that are computed here."""

import gzip
import json
import math
import pickle
import struct
import warnings
import zlib
from pathlib import Path

import numpy
import pytest

import voxcast

GRID = (200, 200, 16)
CAMERAS = ["CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT"]


def png(height: int, width: int, profile: bool) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    colours = chunk(b"iCCP", b"x\0\0" + zlib.compress(bytes(128))) if profile else b""
    rows = chunk(b"IDAT", zlib.compress(b"".join(b"\0" + bytes([row % 256] * 3 * width) for row in range(height))))
    return b"\x89PNG\r\n\x1a\n" + head + colours + rows + chunk(b"IEND", b"")


def blocks(seed: int, free: int) -> numpy.ndarray:
    """Labels: a few blocks of every class below `free`, and nothing between."""
    random = numpy.random.default_rng(seed)
    labels = numpy.full(GRID, free, numpy.uint8)
    for label in range(free):
        for _ in range(6):
            x, y, z = (random.integers(0, size - 3) for size in GRID)
            labels[x : x + 6, y : y + 9, z : z + 3] = label
    return labels


def nuscenes(root: Path, labels: numpy.ndarray, size: tuple[int, int], lidars: list[list[float]]) -> str:
    """A scene with a key frame for each place of the lidar, all with the same labels and images with a colour profile."""
    tables: dict[str, list] = {
        name: [] for name in ["sensor", "calibrated_sensor", "ego_pose", "sample_data", "scene", "sample"]
    }
    tables["scene"].append({"token": "s", "name": "scene-0103"})
    for index, name in enumerate([*CAMERAS, "LIDAR_TOP"]):
        camera = name != "LIDAR_TOP"
        half = math.pi * index / 6
        s, c = math.sin(half) * math.sqrt(0.5), math.cos(half) * math.sqrt(0.5)
        tables["sensor"].append({"token": name, "channel": name})
        tables["calibrated_sensor"].append(
            {
                "token": name,
                "sensor_token": name,
                "translation": [1.1, 0, 1.6] if camera else [0.9858, 0.013, 1.8402],
                "rotation": [c, -c, -s, s] if camera else [math.sqrt(0.5), 0, 0, -math.sqrt(0.5)],
                "camera_intrinsic": [[size[1] / 2, 0, size[1] / 2], [0, size[1] / 2, size[0] / 2], [0, 0, 1]]
                if camera
                else [],
            }
        )
    (root / "samples").mkdir(parents=True)
    (root / "samples" / "image.png").write_bytes(png(*size, profile=True))
    for frame, place in enumerate(lidars):
        tables["sample"].append({"token": f"t{frame}", "scene_token": "s", "timestamp": frame})
        for name in [*CAMERAS, "LIDAR_TOP"]:
            token = f"{name}-{frame}"
            tables["ego_pose"].append({"token": token, "translation": place, "rotation": [1, 0, 0, 0]})
            tables["sample_data"].append(
                {
                    "token": token,
                    "sample_token": f"t{frame}",
                    "ego_pose_token": token,
                    "calibrated_sensor_token": name,
                    "filename": "samples/image.png",
                    "is_key_frame": True,
                    "height": size[0],
                    "width": size[1],
                }
            )
        target = root / "openocc_v2" / "scene-0103" / f"t{frame}"
        target.mkdir(parents=True)
        numpy.savez_compressed(target / "labels.npz", semantics=labels, flow=numpy.zeros((*GRID, 2), numpy.float16))
    (root / "v1.0-mini").mkdir()
    for name, rows in tables.items():
        (root / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    return f"openocc:{root}:{root / 'openocc_v2'}"


def rendered(labels: numpy.ndarray, origin: numpy.ndarray) -> tuple[numpy.ndarray, numpy.ndarray]:
    """Class and distance along the rays from `origin`: of each ray, every border of a voxel that it crosses, sorted."""
    pitches = [math.atan(k) - math.pi / 2 for k in range(1, 11)]
    while pitches[-1] < 0.21:
        pitches.append(2 * pitches[-1] - pitches[-2])
    azimuths = numpy.deg2rad(numpy.arange(360))
    directions = numpy.array(
        [[math.cos(p) * math.cos(a), math.cos(p) * math.sin(a), math.sin(p)] for p in pitches for a in azimuths],
        numpy.float32,
    )
    low, edge = numpy.array([-40.0, -40.0, -1.0]), float(numpy.float32(0.4))
    start = ((origin - low) / edge).astype(numpy.float32).astype(float)
    classes, distances = [], []
    for end in ((directions + origin - low) / edge).astype(numpy.float32).astype(float):
        along = (end - start) / numpy.linalg.norm(end - start)
        with numpy.errstate(divide="ignore", invalid="ignore"):
            borders = [(numpy.arange(GRID[axis] + 1) - start[axis]) / along[axis] for axis in range(3)]
        times = numpy.unique(numpy.concatenate([border[numpy.isfinite(border) & (border > 0)] for border in borders]))
        middles = (numpy.concatenate([[0], times[:-1]]) + times) / 2
        voxels = numpy.floor(start + middles[:, None] * along).astype(int)
        inside = ((voxels >= 0) & (voxels < GRID)).all(axis=1)
        voxels, times = voxels[inside], times[inside]
        met = labels[tuple(voxels.T)]
        first = numpy.flatnonzero(met != 16)
        at = first[0] if len(first) else -1
        classes.append(met[at])
        distances.append(numpy.float32(times[at]) * numpy.float32(0.4))
    return numpy.array(classes, numpy.uint8), numpy.array(distances, numpy.float32).astype(numpy.float16)


def test_a_submission_is_what_the_challenge_reads(place, program):
    labels = blocks(3, 16)
    # The second frame's lidar is 60 m from the first one's, and no ray starts there.
    lidars = [[500.0, 600.0, 0.0], [560.0, 600.0, 0.0], [497.3, 602.1, 0.2]]
    data = nuscenes(place / "challenge", labels, (64, 96), lidars)
    file = place / "submission.gz"
    program("eval", "--majority", data, "--data", data, "--submission", file, "--about", "team=the testers")
    bytes_ = file.read_bytes()
    submission = pickle.loads(gzip.decompress(bytes_))
    about = {"method": "", "team": "the testers", "authors": "", "e-mail": ""}
    about |= {"institution / company": "", "country / region": ""}
    assert {key: value for key, value in submission.items() if key != "results"} == about
    assert list(submission["results"]) == ["t0", "t1", "t2"]
    mounted = numpy.array([0.9858, 0.013, 1.8402])
    for frame, token in enumerate(submission["results"]):
        result = submission["results"][token]
        origins = [numpy.array(other) - lidars[frame] + mounted for other in lidars]
        origins = [origin for origin in origins if (abs(origin[:2]) < 39).all()]
        assert len(origins) == (1 if frame == 1 else 2)
        found = [rendered(labels, origin) for origin in origins]
        classes, distances = (numpy.concatenate(part) for part in zip(*found, strict=True))
        assert [result[key].dtype.str for key in ("pcd_cls", "pcd_dist", "pcd_flow")] == ["|u1", "<f2", "<f2"]
        assert result["pcd_flow"].shape == (len(classes), 2) and not result["pcd_flow"].any()
        # A ray through the very edge of voxels may go by on either side: the two compute places differently.
        same = (result["pcd_cls"] == classes) & (abs(result["pcd_dist"] - distances) <= 0.004 * distances)
        assert result["pcd_cls"].shape == classes.shape and (~same).sum() <= 3, f"{(~same).sum()} of {len(classes)}"
        assert (result["pcd_dist"] == distances).mean() > 0.999
        assert len(numpy.unique(classes)) > 10
    program("eval", "--majority", data, "--data", data, "--submission", file, "--about", "team=the testers")
    assert file.read_bytes() == bytes_


def test_notes_of_images_are_warned_of_once(place, model):
    data = nuscenes(place / "profiles", blocks(4, 16), model.image_size, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    with pytest.warns(voxcast.Note, match=r"samples/image.png: .*profile") as told:
        voxcast.evaluate(model, data)
    # Of each camera once, not of both frames.
    assert len(told) == 6 and told[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error", voxcast.Note)
        with pytest.raises(voxcast.Note, match="profile"):
            voxcast.evaluate(model, data)


def test_notes_of_scenes_are_warned_of(place, scene):
    scene.save(place / "noted")
    file = place / "noted" / "calibration.json"
    calibration = json.loads(file.read_text())
    calibration["colour_of_the_car"] = "red"
    file.write_text(json.dumps(calibration))
    with pytest.warns(voxcast.Note, match="keys that are not used.*colour_of_the_car") as told:
        voxcast.Scene.open(place / "noted")
    assert told[0].filename == __file__ and issubclass(voxcast.Note, UserWarning)


def uniocc(root: Path, labels: list[numpy.ndarray], masks: list[numpy.ndarray]) -> str:
    """As UniOcc's tools write it: NumPy's archives with lists of dicts, and a pickle that lists them."""
    (root / "scene-0061").mkdir(parents=True)
    extrinsics = numpy.array([[0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.6], [0, 0, 0, 1]], numpy.float32)
    camera = {"filename": "image.png", "intrinsics": numpy.eye(3) * [[40], [40], [1]], "extrinsics": extrinsics}
    for frame, (label, mask) in enumerate(zip(labels, masks, strict=True)):
        numpy.savez_compressed(
            root / "scene-0061" / f"{frame}.npz",
            occ_label=label,
            occ_mask_camera=mask,
            occ_flow_forward=numpy.zeros((*GRID, 3), numpy.float32),
            ego_to_world_transformation=numpy.eye(4),
            annotations=[{"token": "a", "size": numpy.ones(3), "category_id": 1}],
            cameras=[{"name": name, **camera} for name in CAMERAS],
        )
    paths = [f"scene-0061/{frame}.npz" for frame in range(len(labels))]
    infos = [{"scene_name": "scene-0061", "start_frame": 0, "end_frame": numpy.int64(1), "occ_in_scene_paths": paths}]
    (root / "scene_infos.pkl").write_bytes(pickle.dumps(infos))
    return f"uniocc:{root}"


def test_uniocc_as_numpy_writes_it(place, program):
    random = numpy.random.default_rng(8)
    truth = [blocks(5, 10), blocks(6, 10).astype(numpy.int64)]
    masks = [random.random(GRID) < 0.3, (random.random(GRID) < 0.5).astype(numpy.uint8)]
    other = [blocks(7, 10)]
    data, source = uniocc(place / "uniocc", truth, masks), uniocc(place / "other", other, masks[:1])
    program("eval", "--majority", source, "--data", data, "--json", place / "uniocc.json")
    scores = json.loads((place / "uniocc.json").read_text())
    for region, inside in [("all", [numpy.ones(GRID, bool)] * 2), ("camera", [mask.astype(bool) for mask in masks])]:
        there = numpy.concatenate([label[mask] for label, mask in zip(truth, inside, strict=True)])
        said = numpy.concatenate([other[0][mask] for mask in inside])
        ious = [((there == c) & (said == c)).sum() / ((there == c) | (said == c)).sum() for c in range(10)]
        occupied = ((there != 10) & (said != 10)).sum() / ((there != 10) | (said != 10)).sum()
        assert scores["regions"][region]["iou"] == pytest.approx(occupied, abs=1e-12)
        assert scores["regions"][region]["miou"] == pytest.approx(numpy.mean(ious), abs=1e-12)
