"""Models, checkpoints, pages, and what is wrong with files."""

import importlib.util
import json
import pickle
import re
import sys
from pathlib import Path

import numpy
import pytest
import torch

import voxcast

TRAINING = Path(__file__).resolve().parents[2] / "train"

NETWORK = {
    "depths": [1, 1, 1, 1],
    "width": 8,
    "dcn": [False] * 4,
    "fpn": 8,
    "channels": [8, 16, 24, 32],
    "key_dims": [2, 3, 4],
    "bounds": [[-20, 20], [-20, 20], [-5, 3]],
    "classes": 17,
    "image": [64, 96],
    "grids": [[20, 20, 8], [10, 10, 4], [5, 5, 2]],
    "samples": [2, 2, 2],
    "block": "basic",
    "cameras": 2,
}


def test_a_model_says_what_it_is(program, model):
    assert model.checksum in program("inspect", model.path)
    assert model.network["cameras"] == model.cameras == 6
    assert model.image_size == (192, 544) and model.precision in ("f32", "f16")
    assert len(model.bounds) == 3 and len(model.classes) == 17
    assert model.selftest(threads=1) > 50
    assert voxcast.Model.open(model.path, copy=True).checksum == model.checksum
    assert voxcast.__version__ in program("--version")


def test_models_are_pickled_as_a_path_or_as_bytes(model):
    by_path = pickle.loads(pickle.dumps(model))
    assert by_path.path == model.path and len(pickle.dumps(model)) < 1000
    by_bytes = pickle.loads(pickle.dumps(voxcast.Model.from_bytes(model.to_bytes())))
    assert by_bytes.path is None and by_bytes.checksum == model.checksum


def test_errors_are_the_lines_of_the_command_line(place, model):
    (place / "torn.safetensors").write_bytes(model.to_bytes()[:-1000])
    with pytest.raises(voxcast.FormatError, match="torn.safetensors") as raised:
        voxcast.Model.open(place / "torn.safetensors")
    assert raised.value.path == str(place / "torn.safetensors")
    assert isinstance(raised.value, ValueError) and isinstance(raised.value, voxcast.Error)
    with pytest.raises(OSError, match="cannot open") as raised:
        voxcast.Model.open("nowhere.safetensors")
    assert isinstance(raised.value, voxcast.FileError) and raised.value.path == "nowhere.safetensors"
    assert str(raised.value).startswith("nowhere.safetensors: cannot open")
    again = pickle.loads(pickle.dumps(raised.value))
    assert (str(again), again.path) == (str(raised.value), raised.value.path)
    with pytest.raises(voxcast.FileError, match="calibration.json"):
        voxcast.Scene.open(place)
    with pytest.raises(voxcast.UnsupportedError, match="isa") as raised:
        model.selftest(isa="mmx")
    # Types name the instruction sets that there are.
    types = (Path(voxcast.__file__).parent / "_native.pyi").read_text()
    named = re.search(r"_Isa = Literal\[(.*)\]", types).group(1).replace('"', "")
    assert str(raised.value).endswith(f"expected one of {named}")
    for wrong, kind, text in [
        (lambda: voxcast.Model.shipped("f64"), ValueError, 'precision: found "f64"'),
        (lambda: voxcast.import_checkpoint({}, "edge", precision="f64"), ValueError, 'precision: found "f64"'),
        (lambda: voxcast.import_checkpoint({}, "edge", fold="some"), ValueError, 'fold: found "some"'),
        (lambda: voxcast.import_checkpoint(3, "edge"), TypeError, "checkpoint: found int"),
    ]:
        with pytest.raises(kind, match=text):
            wrong()
    with pytest.raises(voxcast.MismatchError, match="threads: found 0"):
        model.selftest(threads=0)


def load_training():
    """The training code, which is no package of this one."""
    sys.path.insert(0, str(TRAINING))
    try:
        from voxcast_train.export import export
        from voxcast_train.network import InverseMatrixVT3D, Network, initialise
    finally:
        sys.path.remove(str(TRAINING))
    return InverseMatrixVT3D, Network, initialise, export


def test_a_module_of_the_training_code_becomes_a_model(program, place):
    InverseMatrixVT3D, Network, initialise, export = load_training()
    network = Network(**{key: tuple(map(tuple, value)) if key in ("bounds", "grids") else value for key, value in NETWORK.items()})
    torch.manual_seed(3)
    module = InverseMatrixVT3D(network)
    initialise(module)
    with torch.no_grad():
        for tensor in module.buffers():
            if tensor.is_floating_point():
                tensor.uniform_(0.5, 1.5)
    in_memory = voxcast.import_checkpoint(module, network)

    # The way by files, through the command line, gives the same bytes.
    (place / "network.json").write_text(json.dumps(NETWORK))
    export(module.state_dict(), place / "weights.safetensors")
    arguments = ["--network", place / "network.json", "-o", place / "imported.safetensors"]
    program("import", place / "weights.safetensors", *arguments, "--no-self-test")
    assert in_memory.to_bytes() == (place / "imported.safetensors").read_bytes()
    assert in_memory.path is None

    from_file = voxcast.import_checkpoint(
        place / "weights.safetensors", place / "network.json", place / "tested.safetensors", threads=1
    )
    assert from_file.selftest(threads=1) > 20
    with pytest.raises(voxcast.UnsupportedError, match="carries no self-test"):
        in_memory.selftest()
    scene = voxcast.Scene.street(in_memory, 1)
    digests = {
        voxcast.Session(model, voxcast.Rig.build(model, scene), threads=1).run(scene).digest
        for model in (in_memory, from_file)
    }
    assert len(digests) == 1

    half = voxcast.import_checkpoint({name: tensor.half() for name, tensor in module.state_dict().items()}, NETWORK, precision="f16")
    assert half.precision == "f16"
    state = {name: tensor.numpy() for name, tensor in module.state_dict().items()}
    name = next(name for name in state if name.endswith("conv1.weight"))
    with pytest.raises(voxcast.FormatError, match=f'tensor "{name}" is missing'):
        voxcast.import_checkpoint({key: value for key, value in state.items() if key != name}, NETWORK)
    with pytest.raises(voxcast.MismatchError, match=f'tensor "{name}" has shape'):
        voxcast.import_checkpoint({**state, name: state[name][1:]}, NETWORK)
    broken = state[name].copy()
    broken.flat[7] = numpy.nan
    with pytest.raises(voxcast.FormatError, match=f'tensor "{name}" is NaN at 7'):
        voxcast.import_checkpoint({**state, name: broken}, NETWORK)
    with pytest.raises(voxcast.FileError, match="neither a file nor one of nuscenes-200"):
        voxcast.import_checkpoint(state, "nuscenes-201")
    with pytest.raises(TypeError, match="network: found int"):
        voxcast.import_checkpoint(state, 7)


def test_a_page_shows_itself(place, model, rig, scene):
    occupancy = voxcast.Session(model, rig, threads=1).run(scene)
    page = voxcast.view(occupancy, scene, title="a <street>")
    assert page.html.startswith("<!doctype html>") or page.html.startswith("<!DOCTYPE html>")
    assert occupancy.digest in page.html and "a <street>" not in page.html
    cell = page._repr_html_()
    assert cell.startswith("<iframe srcdoc=") and 'sandbox="allow-scripts"' in cell
    page.save(place / "page.html")
    assert (place / "page.html").read_text() == page.html
    bare = voxcast.view(occupancy)
    assert len(bare.html) < len(page.html)
    with pytest.raises(voxcast.MismatchError, match="truth: shape"):
        voxcast.view(occupancy, truth=scene.truth[1:])


def test_types_are_told():
    assert (Path(voxcast.__file__).parent / "py.typed").exists()
    assert importlib.util.find_spec("voxcast._native") is not None
    for name in voxcast.__all__:
        if name != "__version__":
            assert getattr(voxcast, name).__doc__, name
