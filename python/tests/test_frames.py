"""Frames: the digests of the command line, images of every kind, memory, threads."""

import gc
import threading

import numpy
import pytest

import voxcast


@pytest.fixture
def session(model, rig):
    return voxcast.Session(model, rig, threads=1)


def test_digests_are_those_of_the_command_line(program, place, model, scene, rig):
    scene.save(place / "scene")
    rig.save(place / "rig.safetensors", model)
    printed = program(
        "run", "--model", model.path, "--rig", place / "rig.safetensors", place / "scene", "-o", place / "out.npz", "--logits"
    )
    stored = numpy.load(place / "out.npz")
    opened = voxcast.Scene.open(place / "scene")
    assert opened.names == scene.names
    mapped = voxcast.Rig.open(place / "rig.safetensors", model, len(opened))
    for threads in (1, 2, 3):
        session = voxcast.Session(model, mapped, threads=threads, logits=True)
        occupancy = session.run(opened)
        assert occupancy.digest in printed
        assert numpy.array_equal(occupancy.classes, stored["classes"])
        assert numpy.array_equal(occupancy.support, stored["support"])
        assert occupancy.logits.tobytes() == stored["logits"].tobytes()
        assert numpy.array_equal(occupancy.bounds, stored["bounds"])
        assert numpy.array_equal(occupancy.colours, stored["colours"])
    assert occupancy.classes.shape == tuple(model.grid)
    assert occupancy.logits.shape == (*model.grid, len(model.classes))
    assert occupancy.class_names == model.classes and model.classes[0] == "empty"
    bits = numpy.unpackbits(occupancy.bits(), count=occupancy.classes.size, bitorder="little")
    assert numpy.array_equal(bits.reshape(occupancy.classes.shape), occupancy.classes != 0)


def test_images_of_any_strides_give_the_same_bits(session, scene):
    expected = session.run(scene).digest
    bgr = numpy.stack(scene.images)
    assert bgr.shape == (6, 192, 544, 3)
    wide = numpy.full((6, 194, 600, 4), 77, numpy.uint8)
    wide[:, 1:193, 20:564, :3] = bgr
    planes = numpy.ascontiguousarray(bgr.transpose(0, 3, 1, 2))
    upside_down = numpy.ascontiguousarray(bgr[:, ::-1])
    rgb = numpy.ascontiguousarray(bgr[..., ::-1])
    for images, order in [
        (bgr, "bgr"),
        (rgb, "rgb"),
        (rgb[..., ::-1], "bgr"),
        (wide[:, 1:193, 20:564, :3], "bgr"),
        (planes.transpose(0, 2, 3, 1), "bgr"),
        (upside_down[:, ::-1], "bgr"),
        (numpy.asfortranarray(bgr), "bgr"),
        (list(bgr), "bgr"),
        (scene.images, "bgr"),
        ([rgb[camera] for camera in range(6)], "rgb"),
    ]:
        assert session.run(images, order=order).digest == expected
    assert session.run(bgr, order="rgb").digest != expected, "images in which colours matter"
    assert voxcast.Scene(rgb, scene.lidar2img, order="rgb", names=scene.names).images[2].tobytes() == bgr[2].tobytes()


def test_what_is_no_image_is_refused_in_one_line(session, scene):
    bgr = numpy.stack(scene.images)
    for images, order, kind, text in [
        (bgr, None, TypeError, 'give order="bgr" or order="rgb"'),
        (bgr, "gbr", ValueError, 'order: found "gbr"'),
        (scene, "bgr", TypeError, "a scene knows its own"),
        (bgr.astype(numpy.float32), "bgr", TypeError, "images: found float32 [6, 192, 544, 3], expected uint8"),
        (bgr[0], "bgr", TypeError, "images: found uint8 [192, 544, 3], expected uint8 [cameras,"),
        (bgr[..., :2], "bgr", voxcast.MismatchError, "image 0: shape [192, 544, 2]"),
        (bgr[:5], "bgr", voxcast.MismatchError, "5 images, the rig has 6 cameras"),
        (bgr[:, :64], "bgr", voxcast.MismatchError, "image 0: 64x544 (height x width)"),
        ([bgr[0]] * 5 + [bgr], "bgr", TypeError, "image 5: found uint8 [6, 192, 544, 3], expected uint8 [height"),
        (numpy.zeros((0, 192, 544, 3), numpy.uint8), "bgr", voxcast.MismatchError, "0 images"),
        (7, "bgr", TypeError, "int"),
    ]:
        with pytest.raises(kind) as raised:
            session.run(images, order=order)
        assert text in str(raised.value) and "\n" not in str(raised.value)


def test_results_stay_are_not_copied_and_lend_their_memory(session, scene):
    first = session.run(scene)
    digest, classes = first.digest, first.classes
    assert not classes.flags.owndata and classes.base is first
    assert classes.ctypes.data == first.classes.ctypes.data, "the same memory"
    with pytest.raises(ValueError):
        classes[0, 0, 0] = 1
    with pytest.raises(ValueError):
        classes.flags.writeable = True
    before = classes.copy()
    other = session.run([image[::-1, ::-1] for image in scene.images], order="bgr")
    assert other.digest != digest and first.digest == digest
    del first
    gc.collect()
    assert numpy.array_equal(classes, before), "the array keeps the result"
    # In a loop, results move between a few places.
    places = set()
    del other, classes
    for _ in range(8):
        occupancy = session.run(scene)
        places.add(occupancy.classes.ctypes.data)
    assert len(places) <= 4
    del session
    gc.collect()
    assert occupancy.digest == digest, "a result outlives its session"


def test_confidence_is_that_of_the_command_line(program, place, model, scene, rig):
    scene.save(place / "sure")
    program("run", "--model", model.path, place / "sure", "-o", place / "sure.npz", "--confidence")
    stored = numpy.load(place / "sure.npz")
    occupancy = voxcast.Session(model, rig, threads=2, confidence=True, logits=True).run(scene)
    assert numpy.array_equal(occupancy.confidence_occupied, stored["confidence_occupied"])
    assert numpy.array_equal(occupancy.confidence_class, stored["confidence_class"])
    scaled = occupancy.logits.astype(float) / model.temperature
    powers = numpy.exp(scaled - scaled.max(-1, keepdims=True))
    shares = powers / powers.sum(-1, keepdims=True)
    assert numpy.abs(occupancy.confidence_occupied - 255 * (1 - shares[..., 0])).max() < 0.51
    assert numpy.abs(occupancy.confidence_class - 255 * shares.max(-1)).max() < 0.51
    assert not occupancy.confidence_class.flags.writeable
    page = voxcast.view(occupancy, scene).html
    plain = voxcast.Session(model, rig).run(scene)
    assert plain.confidence_occupied is None and plain.confidence_class is None
    assert plain.digest == occupancy.digest
    assert '"confidence":null' in voxcast.view(plain).html and '"confidence":null' not in page


def test_memory_is_told_beforehand(model, rig):
    for threads, logits, confidence in [(1, False, False), (2, True, False), (1, False, True)]:
        told = voxcast.Session.memory(model, threads=threads, logits=logits, confidence=confidence)
        session = voxcast.Session(model, rig, threads=threads, logits=logits, confidence=confidence)
        assert session.taken == told
        assert told.total == told.arena + told.images + told.output + told.tables
    assert voxcast.Session.memory(model, 3).images * 2 == voxcast.Session.memory(model, 6).images


def test_cameras_one_by_one(model, rig, scene):
    session = voxcast.Session(model, rig, threads=1)
    expected = voxcast.Session(model, rig, threads=1).run(scene)
    assert session.occupancy is None and session.step() == "idle"
    for camera, image in reversed(list(enumerate(scene.images))):
        session.set_camera(camera, image[..., ::-1], order="rgb")
    steps = 1
    while session.step(slices=20) == "running":
        steps += 1
    assert steps > 3 and session.longest_slice > 0
    occupancy = session.occupancy
    assert occupancy is session.occupancy
    assert occupancy.digest == expected.digest
    assert [camera.image for camera in occupancy.cameras] == [1] * 6

    session.set_camera(3, scene.images[3], order="bgr")
    while session.step(seconds=0.01) == "running":
        pass
    again = session.occupancy
    assert again is not occupancy and again.digest == expected.digest
    assert [camera.age for camera in again.cameras] == [1, 1, 1, 0, 1, 1]

    session.mask(0)
    session.mask(4)
    assert session.step() == "complete"
    masked = session.occupancy
    assert [camera.masked for camera in masked.cameras] == [True, False, False, False, True, False]
    assert masked.digest != expected.digest and (masked.support == 0).sum() > (expected.support == 0).sum()
    session.mask(0, False)
    session.mask(4, False)
    assert session.step() == "complete" and session.occupancy.digest == expected.digest

    for wrong, text in [
        (lambda: session.set_camera(6, scene.images[0], order="bgr"), "camera 6, the rig has 6 cameras"),
        (lambda: session.set_camera(0, scene.images[0][:64], order="bgr"), "image 0: 64x544"),
        (lambda: session.mask(9), "camera 9"),
        (lambda: session.step(seconds=-1.0), "seconds: found -1"),
        (lambda: session.step(seconds=1.0, slices=3), "expected one of them"),
    ]:
        with pytest.raises(ValueError, match=text):
            wrong()


def test_rigs_are_swapped_and_their_matrices_seen(model, rig, scene):
    session = voxcast.Session(model, rig, threads=1)
    expected = session.run(scene).digest
    moved = scene.lidar2img.copy()
    moved[:, :3, 3] += 20.0
    session.set_rig(voxcast.Rig.build(model, moved))
    assert session.step() == "complete" and session.occupancy.digest != expected
    session.set_rig(rig)
    assert session.step() == "complete" and session.occupancy.digest == expected

    matrices = rig.matrices()
    assert sorted(matrices) == [f"level{level}.{name}" for level in (1, 2, 3) for name in ("bev", "volume")]
    ptr, col = matrices["level1.volume"]
    assert ptr.dtype == col.dtype == numpy.uint32 and ptr.base is rig
    assert len(ptr) == numpy.prod(model.grid) // 8 + 1 and ptr[-1] == len(col)
    seen = numpy.diff(ptr).reshape([side // 2 for side in model.grid])
    assert numpy.array_equal(seen.repeat(2, 0).repeat(2, 1).repeat(2, 2), session.occupancy.support)
    with pytest.raises(voxcast.MismatchError, match="the rig has 2 cameras, expected 6"):
        session.set_rig(voxcast.Rig.build(model, scene.lidar2img[:2]))
    with pytest.raises(TypeError, match="lidar2img: found float64"):
        voxcast.Rig.build(model, scene.lidar2img.astype(numpy.float64))


def test_two_sessions_run_side_by_side(model, rig, scene):
    expected = voxcast.Session(model, rig, threads=1).run(scene).digest
    sessions = [voxcast.Session(model, rig, threads=1) for _ in range(2)]
    inside = threading.Barrier(2, timeout=60)
    found: list[list[str]] = [[], []]

    def work(which: int) -> None:
        for _ in range(3):
            inside.wait()
            found[which].append(sessions[which].run(scene).digest)

    threads = [threading.Thread(target=work, args=(which,)) for which in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [[expected] * 3] * 2


def test_the_interpreter_goes_on_while_a_frame_runs(model, rig, scene):
    session = voxcast.Session(model, rig, threads=1)
    session.run(scene)
    running, turns, busy = threading.Event(), 0, 0

    def work() -> None:
        running.set()
        for _ in range(3):
            session.run(scene)
        running.clear()

    thread = threading.Thread(target=work)
    thread.start()
    running.wait()
    while thread.is_alive():
        turns += 1
        try:
            session.taken
        except voxcast.BusyError as error:
            assert "another thread is using the session" in str(error)
            busy += 1
    thread.join()
    # With the interpreter's lock held, this thread would have had a turn or two between frames.
    assert turns > 100 and busy > 100
