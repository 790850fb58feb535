"""A whole run on made-up frames, through the program that will use its result. Needs a built `voxcast`."""

import json
import os
import subprocess
import sys
import tempfile
import unittest
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy
import torch
from safetensors.torch import load_file

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
sys.path.insert(0, str(HERE))

import made_up  # noqa: E402

from voxcast_train.across import summary  # noqa: E402
from voxcast_train.calibrate import BIAS  # noqa: E402
from voxcast_train.config import Config, Tail  # noqa: E402
from voxcast_train.data import Frames  # noqa: E402
from voxcast_train.errors import InputError  # noqa: E402
from voxcast_train.evaluate import covered_by, evaluate, evaluate_majority, evaluate_masked, load_model  # noqa: E402
from voxcast_train.export import export  # noqa: E402
from voxcast_train.losses import level_losses  # noqa: E402
from voxcast_train.metrics import Confusion  # noqa: E402
from voxcast_train.network import InverseMatrixVT3D, Network, initialise  # noqa: E402
from voxcast_train.program import Program  # noqa: E402
from voxcast_train.reproduce import reproduce  # noqa: E402
from voxcast_train.rig import Rig  # noqa: E402
from voxcast_train.tail import STAGE, VOLUMES, train_tail  # noqa: E402
from voxcast_train.train import run  # noqa: E402
from voxcast_train.unpack import restore_norms, unpack  # noqa: E402
from voxcast_train.workers import Worker, run_workers  # noqa: E402

CPU = torch.device("cpu")


def program() -> Path:
    """$VOXCAST, or the newest build in target/."""
    if named := os.environ.get("VOXCAST"):
        return Path(named)
    built = [HERE.parents[1] / "target" / kind / "voxcast" for kind in ("release", "debug")]
    built = [path for path in built if path.exists()]
    assert built, "no voxcast in target/: run `cargo build --release`, or name one with VOXCAST"
    return max(built, key=lambda path: path.stat().st_mtime)


def voxcast(*arguments) -> str:
    """Runs the program."""
    done = subprocess.run([program(), *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == 0, f"voxcast {arguments}: {done.stderr}"
    return done.stdout


def average_in_worker(work: Path, worker: Worker) -> None:
    """The two parameters of worker r have the gradients [r + 1, r + 1] and [[10 (r + 1)]]."""
    parameters = [torch.nn.Parameter(torch.zeros(2)), torch.nn.Parameter(torch.zeros(1, 1))]
    for parameter, value in zip(parameters, (1.0, 10.0)):
        parameter.grad = torch.full_like(parameter, value * (worker.rank + 1))
    worker.average_gradients(parameters)
    torch.save([parameter.grad for parameter in parameters], work / f"gradients{worker.rank}.pt")


def fail_in_worker(worker: Worker) -> None:
    raise InputError("no frames there")


class Run(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.place = tempfile.TemporaryDirectory()
        cls.work = Path(cls.place.name)
        made_up.write_network(cls.work)
        made_up.write_set(cls.work / "train", 0, 8)
        made_up.write_set(cls.work / "tune", 100, 4)
        frame = next((cls.work / "train").iterdir())
        voxcast("rig", frame, "--network", cls.work / "network.json", "-o", cls.work / "rig.safetensors")

    @classmethod
    def tearDownClass(cls):
        cls.place.cleanup()

    def config(self, name: str, **changes) -> Config:
        values = {
            "train": {"first": 0, "count": 8},
            "tune": {"first": 100, "count": 4},
            "held_out": {"first": 200, "count": 0},
            "steps": 150,
            "batch": 4,
            "threads": 1,
            "learning_rate": 4e-3,
            "warm_up": 5,
            "average": 0.9,
            "momentum": 0.1,
            "log_every": 10,
            "save_every": 20,
            "evaluate_every": 50,
        }
        path = self.work / f"{name}.json"
        path.write_text(json.dumps({**values, **changes}))
        return Config.load(path)

    def work_of(self, name: str) -> Path:
        """A directory of its own for a run, which shares the sets and the rig."""
        directory = self.work / name
        directory.mkdir()
        for shared in ("train", "tune", "rig.safetensors"):
            (directory / shared).symlink_to(self.work / shared)
        return directory

    def test_it_learns_and_the_runtime_agrees(self):
        config, work = self.config("whole"), self.work_of("whole")
        run(config, work, CPU)
        rows = [json.loads(line) for line in (work / "log.jsonl").read_text().splitlines()]
        losses = [row["total"] for row in rows if row["kind"] == "train"]
        self.assertLess(losses[-1], 0.6 * losses[0])
        evaluations = [row for row in rows if row["kind"] == "evaluate"]
        self.assertEqual([row["step"] for row in evaluations], [50, 100, 150])
        self.assertGreater((work / "curve.png").stat().st_size, 10_000)

        network = config.load_network()
        rig = Rig.load(work / "rig.safetensors", network)
        frames = Frames([work / "tune"], network, pixels=False)
        export(torch.load(work / "state.pt", weights_only=True)["average"], work / "checkpoint.safetensors")
        model = load_model(network, work / "checkpoint.safetensors")
        ours = evaluate(model, rig, frames, CPU).report()
        baseline = evaluate_majority(Frames([work / "train"], network, pixels=False).majority(), frames).report()
        self.assertGreater(ours["all"]["iou"], 70.0)
        self.assertGreater(ours["all"]["miou"], 2.0 * baseline["all"]["miou"])

        # The same weights, rig and frame through the runtime.
        voxcast("import", work / "checkpoint.safetensors", "--network", self.work / "network.json", "-o", work / "model")
        frame = frames.paths[1]
        voxcast("run", "--model", work / "model", "--rig", work / "rig.safetensors", frame, "--logits", "-o", work / "out.npz")
        with torch.no_grad():
            logits = model(frames.batch([1])["images"], rig)[0][0].numpy()
        theirs = numpy.load(work / "out.npz")
        self.assertEqual(theirs["logits"].shape, logits.shape)
        scale = float(numpy.sqrt((logits**2).mean()))
        difference = float(numpy.abs(theirs["logits"] - logits).max())
        self.assertLess(difference, 2e-3 * scale, "PyTorch and voxcast differ")
        self.assertGreater(scale, 0.5)
        self.assertGreater(float((theirs["classes"] == logits.argmax(-1)).mean()), 0.999)

    def test_an_interrupted_run_takes_the_same_steps(self):
        whole, parts = self.work_of("uninterrupted"), self.work_of("interrupted")
        run(self.config("steps40", steps=40), whole, CPU)

        class Interrupt(Exception):
            pass

        import voxcast_train.train as module

        real = module.Training.take_step

        def failing(training, *arguments):
            if training.step == 27:
                raise Interrupt
            return real(training, *arguments)

        module.Training.take_step = failing
        try:
            with self.assertRaises(Interrupt):
                run(self.config("steps40", steps=40), parts, CPU)
        finally:
            module.Training.take_step = real
        run(self.config("steps40", steps=40), parts, CPU)
        a, b = (torch.load(work / "state.pt", weights_only=True) for work in (whole, parts))
        for name, tensor in a["average"].items():
            torch.testing.assert_close(tensor, b["average"][name], rtol=1e-4, atol=1e-5, msg=name)
        a, b = ((work / "log.jsonl").read_text().splitlines() for work in (whole, parts))
        self.assertEqual([json.loads(row)["step"] for row in a], [json.loads(row)["step"] for row in b])

    def test_a_run_starts_from_a_model(self):
        """The weights of a model file, which are folded, packed and of half precision, give the function that they came from,
        in evaluation and in training mode; from there a run goes on, first without the volumes."""
        source = self.work_of("source")
        run(self.config("source", steps=60), source, CPU)
        export(torch.load(source / "state.pt", weights_only=True)["average"], source / "checkpoint.safetensors")
        made = ("--network", self.work / "network.json", "--precision", "f16", "--exact", "-o", source / "model")
        voxcast("import", source / "checkpoint.safetensors", *made)
        network = self.config("source").load_network()
        rig = Rig.load(source / "rig.safetensors", network)
        frames = Frames([source / "train"], network, pixels=True)
        images = frames.batch(list(range(8)))["images"]
        unpacked = InverseMatrixVT3D(network)
        initialise(unpacked)
        spread = unpacked.img_backbone.layer1[0].conv1.weight.std().item()
        unpack(source / "model", unpacked)
        self.assertAlmostEqual(unpacked.img_backbone.layer1[0].conv1.weight.std().item(), spread, places=6)
        original = load_model(network, source / "checkpoint.safetensors")
        with torch.no_grad():
            expected = original(images, rig, range(4))
            for mode in ("unpacked", "restored", "training"):
                if mode == "restored":
                    restore_norms(unpacked, lambda: unpacked(images, rig, range(4)))
                unpacked.train(mode == "training")
                for level, (a, b) in enumerate(zip(expected, unpacked(images, rig, range(4)))):
                    with self.subTest(mode, level=level):
                        self.assertLess(float((a - b).abs().max()), 0.02 * float(a.square().mean().sqrt()))

        phases = [{"start": 0, "volumes": False}, {"start": 10}]
        work = self.work_of("continued")
        config = self.config("continued", steps=20, after="source.json", phases=phases, workers=2, threads=1)
        with self.assertRaisesRegex(InputError, "source.json.*--from"):
            run(config, work, CPU)
        run(config, work, CPU, source / "model")
        rows = [json.loads(line) for line in (work / "log.jsonl").read_text().splitlines()]
        self.assertEqual(["focal0" in row for row in rows if row["kind"] == "train"], [False, True])
        before, after = (torch.load(path / "state.pt", weights_only=True)["average"] for path in (source, work))
        self.assertEqual(before.keys(), after.keys())
        voxcast("import", source / "checkpoint.safetensors", "--network", self.work / "network.json", "-o", source / "fast")
        with self.assertRaisesRegex(InputError, "winograd: found .*expected direct sums"):
            unpack(source / "fast", unpacked)
        with self.assertRaisesRegex(InputError, "format: found None"):
            unpack(source / "checkpoint.safetensors", unpacked)
        other = Network.load(made_up.write_network(work, fpn=24))
        with self.assertRaisesRegex(InputError, "fpn: found 16, expected 24"):
            unpack(source / "model", InverseMatrixVT3D(other))

    def test_two_workers_share_a_batch(self):
        work = self.work_of("workers")
        run(self.config("workers", steps=20, workers=2, threads=1), work, CPU)
        self.assertEqual(torch.load(work / "state.pt", weights_only=True)["step"], 20)
        rows = [json.loads(line) for line in (work / "log.jsonl").read_text().splitlines()]
        self.assertEqual([(row["kind"], row["step"]) for row in rows], [("train", 10), ("train", 20), ("evaluate", 20)])
        self.assertLess(rows[1]["total"], rows[0]["total"])
        # Every frame of the tuning set was counted once, whichever worker had it.
        network = self.config("workers", workers=2).load_network()
        average = InverseMatrixVT3D(network)
        average.load_state_dict(torch.load(work / "state.pt", weights_only=True)["average"])
        alone = evaluate(average, Rig.load(work / "rig.safetensors", network), Frames([work / "tune"], network, False), CPU)
        self.assertAlmostEqual(rows[2]["all"]["iou"], alone.report()["all"]["iou"], delta=0.5)

    def test_gradients_are_averaged(self):
        run_workers(2, average_in_worker, (self.work,))
        for rank in range(2):
            ours = torch.load(self.work / f"gradients{rank}.pt", weights_only=True)
            self.assertEqual([gradient.tolist() for gradient in ours], [[1.5, 1.5], [[15.0]]])

    def test_a_failing_worker_is_named(self):
        with self.assertRaisesRegex(InputError, "no frames there"):
            run_workers(2, fail_in_worker, ())

    def test_a_state_of_another_config_is_refused(self):
        work = self.work_of("other")
        run(self.config("first", steps=20), work, CPU)
        with self.assertRaisesRegex(InputError, '"learning_rate": found 0.004, expected 0.02'):
            run(self.config("second", steps=20, learning_rate=2e-2), work, CPU)


STREET = {
    "depths": [1, 1, 1, 1], "width": 8, "dcn": [False] * 4, "block": "basic", "fpn": 16, "channels": [16, 16, 24, 32],
    "key_dims": [2, 3, 4], "bounds": [[-27, 27], [-27, 27], [-5.3, 2.7]], "classes": 17, "image": [32, 96],
    "grids": [[28, 28, 4], [14, 14, 2], [7, 7, 1]], "samples": [4, 5, 6], "cameras": 6,
}  # fmt: skip
"""A network for drawn streets, as small as it can be."""


class FromSeeds(unittest.TestCase):
    """Runs that draw their frames."""

    def setUp(self):
        self.place = tempfile.TemporaryDirectory()
        self.work = Path(self.place.name)
        (self.work / "network.json").write_text(json.dumps(STREET))
        self.program = Program(program())

    def tearDown(self):
        self.place.cleanup()

    def config(self, name: str, **changes) -> Config:
        values = {
            "train": {"first": 0, "count": 24},
            "tune": {"first": 500000, "count": 2},
            "held_out": {"first": 1000000, "count": 3},
            "steps": 8,
            "batch": 2,
            "threads": 1,
            "drawn": "beside",
            "ready": 4,
            "drawers": 2,
            "jitter": {"rigs": 1, "degrees": 1, "metres": 0.05, "share": 0.5},
            "masked": 0.5,
            "lovasz_voxels": 500,
            "log_every": 4,
            "phases": [{"start": 0, "volumes": False}, {"start": 4}],
        }
        path = self.work / f"{name}.json"
        path.write_text(json.dumps({**values, **changes}))
        return Config.load(path)

    def test_frames_are_drawn_beside_and_a_model_comes_out(self):
        first = self.config("first", shifts=False)
        ring = {"rigs": 1, "degrees": 1, "metres": 0.05, "share": 0.5}
        tail = {"first": 20000, "count": 4, "steps": 2, "batch": 2, "lovasz_voxels": 500, "volumes": True, "jitter": ring}
        config = self.config("second", after="first.json", tail=tail, minutes=0.02, steps=100, phases=[{"start": 0}])
        self.assertNotEqual(first.identity(), config.identity())
        reports = reproduce(config, self.work / "run", self.program, CPU)
        run_of_first = self.work / "run" / "first"
        rows = [json.loads(line) for line in (run_of_first / "log.jsonl").read_text().splitlines()]
        taught = [row for row in rows if row["kind"] == "train"]
        self.assertEqual([(row["step"], "focal0" in row) for row in taught], [(4, False), (8, True)])
        self.assertTrue(4 <= taught[-1]["frames"] <= 24)
        # Its logits were not shifted.
        averaged = torch.load(run_of_first / "state.pt", weights_only=True)["average"][BIAS]
        self.assertTrue(torch.equal(load_file(run_of_first / "checkpoint.safetensors")[BIAS], averaged))
        # The clock ended the other one.
        state = torch.load(self.work / "run" / "state.pt", weights_only=True)
        self.assertGreaterEqual(state["seconds"], 1.2)
        self.assertLess(state["step"], 100)
        masked = [f"{how} {name}" for name in ("CAM_FRONT", "CAM_BACK") for how in ("with", "without")]
        self.assertTrue({"plain", "jittered", "majority", *masked} <= reports.keys(), reports.keys())
        self.assertEqual(reports["with CAM_BACK"]["all"], reports["plain"]["all"])
        self.assertNotEqual(reports["without CAM_BACK"]["all"], reports["plain"]["all"])
        self.assertIn("jittered", summary(reports))
        self.assertEqual(list((run_of_first / "drawn").glob("*/*.safetensors")), [], "frames that were read are gone")
        of_tail = [sorted(path.stem for path in (self.work / "run" / name).glob("*.safetensors")) for name in ("tail", "tail-01/set")]
        self.assertEqual(of_tail, [["000020002", "000020003"], ["000020000", "000020001"]])
        # The model is one of the network, and its function that of the checkpoint.
        voxcast("selftest", self.work / "run" / "model.safetensors")

    def four_frames(self) -> tuple:
        """A network, four frames and the rig that they have, and a model of which nothing is trained."""
        made_up.write_network(self.work)
        made_up.write_set(self.work / "train", 0, 4)
        voxcast("rig", next((self.work / "train").iterdir()), "--network", self.work / "network.json", "-o", self.work / "rig.safetensors")
        network = Network.load(self.work / "network.json")
        frames, rig = Frames([self.work / "train"], network, pixels=False), Rig.load(self.work / "rig.safetensors", network)
        new = InverseMatrixVT3D(network)
        initialise(new)
        return network, frames, rig, new

    def test_the_end_alone_gets_better_and_nothing_else_changes(self):
        network, frames, rig, new = self.four_frames()
        before = {name: tensor.clone() for name, tensor in new.state_dict().items()}
        first = evaluate(new, rig, frames, CPU).report()["all"]["iou"]
        kept = ("running_mean", "running_var", "num_batches_tracked", "attention_bias_idxs")
        for volumes, trained in ((False, STAGE), (True, VOLUMES)):
            with self.subTest(volumes=volumes):
                model = InverseMatrixVT3D(network)
                model.load_state_dict(before)
                tail = Tail(steps=40, batch=2, learning_rate=1e-2, masked=0.0, volumes=volumes)
                self.assertEqual(train_tail(model, [(rig, frames)], tail, CPU), 40)
                self.assertGreater(evaluate(model, rig, frames, CPU).report()["all"]["iou"], first + 10.0)
                for name, tensor in model.state_dict().items():
                    # A bias before a batch norm that keeps its statistics has a gradient too.
                    changes = name.startswith(trained) and not name.endswith(kept)
                    self.assertEqual(torch.equal(tensor, before[name]), not changes, name)

    def test_an_interrupted_tail_takes_the_steps_that_it_would_have_taken(self):
        network, frames, rig, new = self.four_frames()
        state, output = self.work / "tail.pt", self.work / "tail.safetensors"
        tail = Tail(steps=6, batch=2, learning_rate=1e-3, lovasz_voxels=500, volumes=True)

        def trained(tail: Tail, **options) -> dict:
            model = InverseMatrixVT3D(network)
            model.load_state_dict(new.state_dict())
            self.assertEqual(train_tail(model, [(rig, frames)], tail, CPU, **options), tail.steps)
            return model.state_dict()

        whole = trained(tail)
        left = iter(range(4))

        def interrupted(*arguments):
            if next(left, None) is None:
                raise KeyboardInterrupt
            return level_losses(*arguments)

        with patch("voxcast_train.tail.level_losses", interrupted), self.assertRaises(KeyboardInterrupt):
            trained(tail, state=state, output=output, save_seconds=0.0)
        self.assertEqual(torch.load(state, weights_only=True)["step"], 4)
        halfway = load_model(network, output).state_dict()
        parts = trained(tail, state=state, output=output, save_seconds=0.0)
        for name, tensor in whole.items():
            self.assertTrue(torch.equal(tensor, parts[name]), name)
        written = load_model(network, output).state_dict()
        self.assertTrue(any(not torch.equal(tensor, written[name]) for name, tensor in halfway.items()), "the output follows the run")
        # One that is over gives its result again, a longer one goes on, and another run is refused.
        again = trained(tail, state=state)
        self.assertTrue(all(torch.equal(tensor, again[name]) for name, tensor in whole.items()))
        trained(replace(tail, steps=7), state=state)
        with self.assertRaisesRegex(InputError, "tail.pt: average: found 0.99, expected 0.9;"):
            trained(replace(tail, average=0.9), state=state)

    def test_one_look_at_the_images_scores_every_mask(self):
        made_up.write_network(self.work)
        made_up.write_set(self.work / "set", 0, 2)
        voxcast("rig", next((self.work / "set").iterdir()), "--network", self.work / "network.json", "-o", self.work / "rig.safetensors")
        network = Network.load(self.work / "network.json")
        frames, rig = Frames([self.work / "set"], network, pixels=False), Rig.load(self.work / "rig.safetensors", network)
        model = InverseMatrixVT3D(network)
        initialise(model)
        whole, masked = evaluate_masked(model, rig, frames, CPU)
        self.assertTrue(torch.equal(whole.counts, evaluate(model, rig, frames, CPU).counts))
        for camera, (without, with_it) in enumerate(masked):
            others = 1.0 - torch.eye(network.cameras)[camera]
            alone = Confusion(network)
            for number in range(len(frames)):
                batch = frames.batch([number])
                with torch.no_grad():
                    predicted = model(batch["images"], rig, kept=others[None])[0][0].argmax(-1)
                alone.add(predicted, batch["labels"][0][0], (batch["visible"][0] != 0) & covered_by(rig, network, others))
            self.assertTrue(torch.equal(without.counts, alone.counts), camera)
            self.assertFalse(torch.equal(without.counts, with_it.counts), camera)
            self.assertTrue(torch.equal(with_it.counts.sum(1), whole.counts.sum(1)), "every voxel is there, seen or not")
            self.assertTrue(torch.equal(with_it.counts.sum((1, 3)), without.counts.sum((1, 3))), "of the same voxels")

    def test_a_program_that_fails_is_named(self):
        config = self.config("failing", jitter=None)
        (self.work / "rigs" / "00").mkdir(parents=True)
        self.program.make_set(self.work / "tune", 500000, 2, self.work / "network.json")
        voxcast("rig", self.work / "tune" / "000500000.safetensors", "--network", self.work / "network.json", "-o",
                self.work / "rigs" / "00" / "rig.safetensors")  # fmt: skip
        with self.assertRaisesRegex(InputError, "drawing frames failed.*false synth"):
            run(config, self.work, CPU, program=Program(Path("/bin/false")))
        with self.assertRaisesRegex(InputError, "--voxcast"):
            run(config, self.work, CPU)


if __name__ == "__main__":
    unittest.main()
