"""The parts of training against plain definitions."""

import json
import math
import sys
import tempfile
import unittest
from pathlib import Path
from types import SimpleNamespace

import torch
from safetensors.torch import save_file

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
sys.path.insert(0, str(HERE))

import make_losses  # noqa: E402
import made_up  # noqa: E402

from voxcast_train.auxiliary import PixelHeads, PlaceHeads, places  # noqa: E402
from voxcast_train.calibrate import fit_shifts, miou_of  # noqa: E402
from voxcast_train import rigs  # noqa: E402
from voxcast_train.config import Config, Jitter  # noqa: E402
from voxcast_train.data import CHANGES, DEPTH_BINS, Frames, augment, depth_bins, kept_cameras, order  # noqa: E402
from voxcast_train.errors import InputError  # noqa: E402
from voxcast_train.losses import IGNORED, level_losses, lovasz_softmax, lovasz_softmax_of_some, pooled_labels  # noqa: E402
from voxcast_train.metrics import Confusion  # noqa: E402
from voxcast_train.network import InverseMatrixVT3D, Network  # noqa: E402
from voxcast_train.rig import DenseMatrix, Matrix, Rig  # noqa: E402
from voxcast_train.train import rate, rig_order  # noqa: E402


class Place(unittest.TestCase):
    """A temporary directory with the small network in it."""

    def setUp(self):
        holder = tempfile.TemporaryDirectory()
        self.addCleanup(holder.cleanup)
        self.place = Path(holder.name)
        self.network = Network.load(made_up.write_network(self.place))


class Losses(unittest.TestCase):
    def test_recorded_values(self):
        records = json.loads((HERE / "losses.json").read_text())
        self.assertGreaterEqual(len(records), 9)
        for record in records:
            weights = None if record["class_weights"] is None else torch.tensor(record["class_weights"])
            losses = level_losses(torch.tensor(record["logits"]), torch.tensor(record["labels"]), weights)
            for name, expected in record["losses"].items():
                with self.subTest(case=record["name"], loss=name):
                    self.assertAlmostEqual(losses[name].item(), expected, delta=1e-4 * max(1.0, expected))

    def test_plain_definitions(self):
        for name, logits, labels, weights in make_losses.cases():
            with self.subTest(case=name):
                losses = level_losses(logits.double(), labels, None if weights is None else weights.double())
                for key, expected in plain_losses(logits.tolist(), labels.tolist(), weights).items():
                    self.assertAlmostEqual(losses[key].item(), expected, delta=1e-9 * max(1.0, expected), msg=key)

    def test_lovasz_of_hard_predictions_is_the_jaccard_loss(self):
        draw = torch.Generator().manual_seed(1)
        labels = torch.randint(3, (200,), generator=draw)
        predicted = torch.randint(3, (200,), generator=draw)
        loss = lovasz_softmax(torch.nn.functional.one_hot(predicted, 3).double(), labels)
        jaccard = []
        for c in range(3):
            both = ((labels == c) & (predicted == c)).sum().item()
            either = ((labels == c) | (predicted == c)).sum().item()
            jaccard.append(1.0 - both / either)
        self.assertAlmostEqual(loss.item(), sum(jaccard) / 3, places=12)

    def test_lovasz_of_some_is_close_to_that_of_all(self):
        draw = torch.Generator().manual_seed(2)
        labels = torch.randint(3, (20000,), generator=draw) * (torch.rand(20000, generator=draw) < 0.3)
        sure = torch.rand(20000, 1, generator=draw) < 0.8
        logits = torch.randn(20000, 3, generator=draw) + 2.0 * torch.nn.functional.one_hot(labels, 3)
        logits = torch.where(sure, 20.0 * torch.nn.functional.one_hot(labels, 3), logits)
        probabilities = logits.double().softmax(1)
        every = lovasz_softmax(probabilities, labels).item()
        # Nothing is drawn: right voxels alone are left out.
        self.assertAlmostEqual(lovasz_softmax_of_some(probabilities, labels, 10000).item(), every, delta=0.01)
        torch.manual_seed(3)
        drawn = [lovasz_softmax_of_some(probabilities, labels, 1000).item() for _ in range(20)]
        self.assertAlmostEqual(sum(drawn) / len(drawn), every, delta=0.02)

    def test_gradients_are_finite_at_the_ends(self):
        for name, logits, labels, weights in make_losses.cases():
            logits = logits.clone().requires_grad_()
            sum(level_losses(logits, labels, weights).values()).backward()
            self.assertTrue(bool(logits.grad.isfinite().all()), name)

    def test_nothing_to_count_costs_nothing(self):
        logits = torch.randn(4, 3, requires_grad=True)
        total = sum(level_losses(logits, torch.full((4,), IGNORED)).values())
        total.backward()
        self.assertEqual((total.item(), logits.grad.abs().sum().item()), (0.0, 0.0))

    def test_ignored_voxels_count_nowhere(self):
        draw = torch.Generator().manual_seed(3)
        logits, labels = torch.randn(400, 5, generator=draw, dtype=torch.float64), torch.randint(5, (400,), generator=draw)
        weights = torch.rand(5, generator=draw, dtype=torch.float64)
        ignored = torch.rand(400, generator=draw) < 0.3
        marked = torch.where(ignored, IGNORED, labels)
        for voxels in (0, 399):
            with self.subTest(voxels):
                ours = level_losses(logits, marked, weights, voxels)
                plain = level_losses(logits[~ignored], labels[~ignored], weights, 0)
                for name, value in plain.items():
                    # Voxels that are right are left out where not all are sorted.
                    close = 1e-9 if voxels == 0 or name != "lovasz" else 0.02
                    self.assertAlmostEqual(ours[name].item(), value.item(), delta=close, msg=name)

    def test_pooled_labels(self):
        labels = torch.zeros(8, 8, 8, dtype=torch.uint8)
        labels[0, 0, 0] = 2
        labels[2:4, 0:2, 0:2] = torch.tensor([1, 3, 3, 1, 0, 0, 0, 0]).view(2, 2, 2)
        labels[4:6, 0:2, 0:2] = IGNORED
        levels = pooled_labels(labels, 4)
        self.assertEqual([tuple(level.shape) for level in levels], [(8,) * 3, (4,) * 3, (2,) * 3, (1,) * 3])
        self.assertEqual(levels[1][:3, 0, 0].tolist(), [2, 1, IGNORED])  # one voxel is enough; a tie; all ignored
        self.assertEqual((levels[2][0, 0, 0].item(), levels[2][1, 1, 1].item()), (1, 0))


def plain_losses(logits, labels, weights):
    """The definitions, voxel by voxel."""
    probabilities, truth = [], []
    for row, label in zip(logits, labels):
        if label != IGNORED:
            highest = max(row)
            powers = [math.exp(value - highest) for value in row]
            probabilities.append([power / sum(powers) for power in powers])
            truth.append(label)
    classes = range(len(logits[0]))
    present = sorted(set(truth))

    def log_of(numerator, denominator):
        return 0.0 if denominator <= 0 else min(100.0, -math.log(numerator / denominator)) if numerator > 0 else 100.0

    def three(p, t):
        both = sum(a for a, b in zip(p, t) if b)
        neither = sum(1 - a for a, b in zip(p, t) if not b)
        return log_of(both, sum(p)) + log_of(both, sum(t)) + log_of(neither, sum(not b for b in t))

    focal = [-(1 if weights is None else weights[t].item()) * (1 - p[t]) ** 2 * math.log(p[t]) for p, t in zip(probabilities, truth)]
    lovasz = []
    for c in present:
        errors = sorted(((abs((t == c) - p[c]), t == c) for p, t in zip(probabilities, truth)), reverse=True)
        total = truth.count(c)
        hits, misses, before, loss = total, 0, 0.0, 0.0
        for error, is_c in errors:
            hits, misses = hits - is_c, misses + (not is_c)
            jaccard = 1.0 - hits / (total + misses)
            loss += error * (jaccard - before)
            before = jaccard
        lovasz.append(loss)
    semantic = [three([p[c] for p in probabilities], [t == c for t in truth]) for c in classes if c in present]
    return {
        "focal": sum(focal) / len(focal),
        "lovasz": sum(lovasz) / len(lovasz),
        "geometric": three([1 - p[0] for p in probabilities], [t != 0 for t in truth]),
        "semantic": sum(semantic) / len(semantic),
    }


class Gather(unittest.TestCase):
    def test_mean_and_its_gradient(self):
        # Rows of 2, 0, 1 and 3 pixels out of 2 frames x 2 cameras x 2 x 3.
        ptr, col = torch.tensor([0, 2, 2, 3, 6]), torch.tensor([1, 7, 11, 0, 5, 7])
        matrix = Matrix(ptr, col, 12, 2)
        features = torch.randn(4, 5, 2, 3, requires_grad=True)
        rows = matrix.mean(features, 2)
        pixels = features.permute(0, 2, 3, 1).reshape(2, 12, 5)
        expected = torch.stack(
            [torch.stack([f[col[a:b]].mean(0) if b > a else torch.zeros(5) for a, b in zip(ptr, ptr[1:])]) for f in pixels]
        )
        torch.testing.assert_close(rows, expected)
        weights = torch.randn_like(rows)
        (ours,) = torch.autograd.grad((rows * weights).sum(), features)
        (theirs,) = torch.autograd.grad((expected * weights).sum(), features)
        torch.testing.assert_close(ours, theirs)


    def test_masked_cameras_are_left_out(self):
        # Rows with pixels of camera 0, of camera 1, of both, and of none.
        ptr, col = torch.tensor([0, 2, 3, 6, 6]), torch.tensor([1, 4, 7, 0, 5, 11])
        matrix = Matrix(ptr, col, 12, 2)
        dense = DenseMatrix((matrix.forward.to_dense() > 0).to(torch.bfloat16), matrix.counts, matrix.shares)
        # Eighths, which bf16 holds exactly.
        features = torch.randint(-16, 17, (4, 5, 2, 3)) / 8
        pixels = features.permute(0, 2, 3, 1).reshape(2, 12, 5)
        for kept in ([[1, 1], [1, 1]], [[0, 1], [1, 0]], [[0, 0], [1, 1]]):
            expected = torch.zeros(2, 4, 5)
            for frame, keep in enumerate(kept):
                for row in range(4):
                    mine = [int(c) for c in col[ptr[row] : ptr[row + 1]] if keep[int(c) // 6]]
                    if mine:
                        expected[frame, row] = pixels[frame, mine].mean(0)
            for name, m in (("sparse", matrix), ("dense", dense)):
                with self.subTest(name, kept=kept):
                    torch.testing.assert_close(m.mean(features, 2, torch.tensor(kept).float()), expected)

    def test_shares_of_cameras(self):
        matrix = Matrix(torch.tensor([0, 2, 2, 5]), torch.tensor([1, 4, 0, 5, 11]), 12, 2)
        torch.testing.assert_close(matrix.shares, torch.tensor([[1.0, 0.0], [0.0, 0.0], [2 / 3, 1 / 3]]))
        self.assertEqual(matrix.counts.tolist(), [2, 0, 3])


class Jittered(unittest.TestCase):
    def test_cameras_turn_and_move_and_keep_their_lens(self):
        ring = made_up.ring(3, 64, 96)
        for whole in (True, False):
            moved = rigs.jittered(ring, 2.0, 0.1, seed=4, whole=whole)
            self.assertTrue(torch.equal(moved, rigs.jittered(ring, 2.0, 0.1, seed=4, whole=whole)))
            self.assertFalse(torch.equal(moved, rigs.jittered(ring, 2.0, 0.1, seed=5, whole=whole)))
            for before, after in zip(ring.double(), moved.double()):
                # K R (K R)^T = K K^T
                lens = [m[:3, :3] @ m[:3, :3].T for m in (before, after)]
                torch.testing.assert_close(lens[0], lens[1], rtol=1e-5, atol=1e-2)
                turn = torch.linalg.solve(before[:3, :3], after[:3, :3])
                degrees = math.degrees(math.acos(min(1.0, (float(turn.trace()) - 1.0) / 2.0)))
                places = [-torch.linalg.solve(m[:3, :3], m[:3, 3]) for m in (before, after)]
                metres = float((places[1] - places[0]).norm())
                if whole:
                    self.assertAlmostEqual(degrees, 2.0, delta=0.01)
                    self.assertAlmostEqual(metres, 0.1, delta=1e-3)
                self.assertTrue(degrees < 2.01 and metres < 0.101, (degrees, metres))

    def test_rigs_take_turns_by_their_shares(self):
        jitter = Jitter(rigs=4, degrees=1.0, metres=0.05, share=0.4)
        order = rig_order(SimpleNamespace(jitter=jitter))
        self.assertEqual([order.count(rig) for rig in range(5)], [6, 1, 1, 1, 1])
        self.assertEqual(rig_order(SimpleNamespace(jitter=None)), [0])


class RigFiles(Place):
    def tensors(self):
        tensors = {}
        for level, (x, y, z) in enumerate(self.network.grids, 1):
            for name, rows in (("volume", x * y * z), ("bev", x * y)):
                tensors[f"level{level}.{name}.ptr"] = torch.zeros(rows + 1, dtype=torch.uint32)
                tensors[f"level{level}.{name}.col"] = torch.zeros(0, dtype=torch.uint32)
        return tensors

    def test_sizes_are_checked(self):
        path = self.place / "rig"
        save_file(self.tensors(), path)
        Rig.load(path, self.network)
        for name, tensor, message in (
            ("level2.bev.ptr", torch.zeros(3, dtype=torch.uint32), "level2.bev: found 2 rows, expected 80"),
            ("level3.volume.col", torch.tensor([18], dtype=torch.uint32), "level3.volume"),
            ("level1.volume.ptr", None, "level1.volume.ptr"),
        ):
            tensors = self.tensors()
            if tensor is None:
                del tensors[name]
            else:
                tensors[name] = tensor
            save_file(tensors, path)
            with self.subTest(name), self.assertRaisesRegex(InputError, message):
                Rig.load(path, self.network)


class Networks(Place):
    def test_names_and_shapes_are_the_published_ones(self):
        shapes = {name: tuple(tensor.shape) for name, tensor in InverseMatrixVT3D(self.network).state_dict().items()}
        for name, shape in {
            "img_backbone.conv1.weight": (8, 3, 7, 7),
            "img_backbone.layer2.0.downsample.0.weight": (16, 8, 1, 1),
            "img_backbone.layer4.0.bn2.running_var": (64,),
            "img_neck.lateral_convs.1.conv.weight": (16, 32, 1, 1),
            "img_neck.fpn_convs.0.conv.bias": (16,),
            "view_transformer.imvts.0.down_conv3d.0.weight": (16, 16, 1, 1, 1),
            "view_transformer.imvts.1.xy_conv.6.bias": (24,),
            "view_transformer.imvts.2.combine_coeff.weight": (1, 32, 1, 1, 1),
            "view_transformer.imvts.1.bev_attn_layer.mixer.m.attn.qkvs.3.c.weight": (9, 3, 1, 1),
            "view_transformer.imvts.1.bev_attn_layer.mixer.m.attn.attention_biases": (8, 49),
            "view_transformer.imvts.1.aspp_xy.aspp.convs.4.0.weight": (12, 12, 3, 3),
            "view_transformer.imvts.1.aspp_xy.aspp.convs.5.1.weight": (12, 12, 1, 1),
            "view_transformer.up_sample1.0.weight": (16, 16, 4, 4, 4),
            "view_transformer.refine_lvl3.1.running_mean": (32,),
            "occ_head.mlp_occ_lvl0.4.bias": (5,),
        }.items():
            self.assertEqual(shapes.get(name), shape, name)

    def test_bottlenecks_have_four_times_the_width(self):
        network = Network.load(made_up.write_network(self.place, block="bottleneck", depths=[1, 2, 1, 1]))
        shapes = {name: tuple(tensor.shape) for name, tensor in InverseMatrixVT3D(network).state_dict().items()}
        self.assertEqual(shapes["img_backbone.layer1.0.downsample.0.weight"], (32, 8, 1, 1))
        self.assertEqual(shapes["img_backbone.layer2.1.conv1.weight"], (16, 64, 1, 1))
        self.assertEqual(shapes["img_neck.lateral_convs.2.conv.weight"], (16, 256, 1, 1))

    def test_what_cannot_be_trained_is_refused(self):
        for changes, message in (
            ({"dcn": [False, False, True, True]}, '"dcn"'),
            ({"key_dims": [2, 3, 5]}, '"key_dims"'),
            ({"nonsense": 1}, "nonsense"),
        ):
            with self.subTest(changes), self.assertRaisesRegex(InputError, message):
                Network.load(made_up.write_network(self.place, **changes))


class Data(Place):
    def test_a_frame_comes_back(self):
        made_up.write_set(self.place / "set", 3, 2)
        frames = Frames([self.place / "set"], self.network, pixels=True)
        frame = made_up.frame(4)
        batch = frames.batch([1])
        self.assertTrue(torch.equal(batch["images"][0], frame["images"]))
        self.assertTrue(torch.equal(batch["labels"][0][0], frame["labels"]))
        self.assertEqual(batch["labels"][3].shape, (1, 4, 5, 1))
        self.assertEqual(batch["pixel_class"].shape, (1, 3, 16, 24))
        self.assertEqual(batch["pixel_class"][0, 0, :, 0].tolist(), [self.network.classes] * 8 + [1] * 8)
        self.assertTrue(bool((batch["pixel_depth"][0, :, :8] == IGNORED).all()))

    def test_wrong_frames_are_refused(self):
        for name, change, message in (
            ("shape", lambda f: f.update(images=f["images"][:, :32].contiguous()), "images: found"),
            ("rig", lambda f: f["lidar2img"].mul_(1.01), "lidar2img: differs"),
            ("missing", lambda f: f.pop("pixel.depth"), "no tensor pixel.depth"),
        ):
            directory = self.place / name
            made_up.write_set(directory, 0, 1)
            frame = made_up.frame(1)
            change(frame)
            save_file(frame, directory / "000000001.safetensors")
            with self.subTest(name), self.assertRaisesRegex(InputError, message):
                Frames([directory], self.network, pixels=True)
        with self.assertRaisesRegex(InputError, "no frames"):
            Frames([self.place / "nowhere"], self.network, pixels=True)

    def test_depth_bins(self):
        bins = depth_bins(torch.tensor([0.5, 1.0, 80.0, 79.0, math.inf, math.sqrt(80.0) * 1.01], dtype=torch.float16))
        self.assertEqual(bins.tolist(), [0, 0, DEPTH_BINS - 1, DEPTH_BINS - 1, IGNORED, DEPTH_BINS // 2])

    def test_each_epoch_has_every_frame_once(self):
        seen = [number for step in range(5) for number in order(7, 10, 2, step)]
        self.assertEqual(sorted(seen), list(range(10)))
        again = [number for step in range(5, 10) for number in order(7, 10, 2, step)]
        self.assertEqual(sorted(again), list(range(10)))
        self.assertNotEqual(seen, again)

    def test_augmentation_stays_in_range_and_keeps_the_picture(self):
        torch.manual_seed(5)
        ramp = torch.linspace(40, 200, 32 * 48).view(1, 1, 32, 48, 1).expand(8, 2, 32, 48, 3).to(torch.uint8)
        changed = augment(ramp)
        self.assertTrue(bool(((changed >= 0) & (changed <= 255)).all()))
        self.assertGreater((changed - ramp).abs().mean().item(), 5.0)
        for frame in changed:
            pair = torch.stack((frame.flatten(), ramp[0].float().flatten()))
            self.assertGreater(torch.corrcoef(pair)[0, 1].item(), 0.8)

    def test_every_change_is_none_at_no_strength(self):
        torch.manual_seed(6)
        images = torch.rand(2, 3, 32, 48, 3) * 255
        for change, first, end in CHANGES:
            with self.subTest(change.__name__):
                self.assertLess(first, end)
                strength = torch.tensor([0.0, 1.0]).view(2, 1, 1, 1, 1)
                changed = change(images, strength)
                torch.testing.assert_close(changed[0], images[0])
                self.assertGreater((changed[1] - images[1]).abs().mean().item(), 1.0)

    def test_one_camera_at_most_is_masked(self):
        torch.manual_seed(7)
        kept = kept_cameras(2000, 6, 0.25, "cpu")
        lost = 6 - kept.sum(1)
        self.assertEqual(sorted(set(lost.tolist())), [0.0, 1.0])
        self.assertAlmostEqual(lost.mean().item(), 0.25, delta=0.04)
        self.assertTrue(bool(((1 - kept).sum(0) > 40).all()), "every camera has its turn")

    def test_majority(self):
        made_up.write_set(self.place / "set", 0, 3)
        for seed in range(3):
            frame = made_up.frame(seed)
            frame["labels"].fill_(0)
            frame["labels"][0, 0, :3] = torch.tensor([[2, 2, 3], [0, 2, 3], [0, IGNORED, 1]][seed])
            save_file(frame, self.place / "set" / f"{seed:09}.safetensors")
        majority = Frames([self.place / "set"], self.network, pixels=False).majority()
        self.assertEqual(majority[0, 0, :3].tolist(), [0, 2, 3])
        self.assertEqual(int(majority.sum()), 5)


class Metrics(Place):
    def test_scores_by_hand(self):
        grid = self.network.output_grid()
        labels, predicted = torch.zeros(grid, dtype=torch.uint8), torch.zeros(grid, dtype=torch.uint8)
        visible = torch.zeros(grid, dtype=torch.uint8)
        labels[0, 0, :4] = torch.tensor([1, 1, 2, IGNORED])  # a far corner
        predicted[0, 0, :4] = torch.tensor([1, 2, 2, 3])
        middle = grid[0] // 2, grid[1] // 2
        labels[middle][0], predicted[middle][1] = 4, 4  # near: missed, and made up
        visible[0, 0, 0] = visible[middle][0] = 1
        confusion = Confusion(self.network)
        confusion.add(predicted, labels, visible)
        report = confusion.report()
        self.assertEqual(report["all"]["classes"], [50.0, 50.0, None, 0.0])
        self.assertAlmostEqual(report["all"]["miou"], 100.0 / 3)
        self.assertAlmostEqual(report["all"]["iou"], 60.0)
        self.assertEqual((report["near"]["iou"], report["far"]["iou"]), (0.0, 100.0))
        self.assertEqual(report["seen"]["classes"], [100.0, None, None, 0.0])
        self.assertEqual(report["near seen"]["classes"], [None, None, None, 0.0])


class TrainingHeads(Place):
    def test_places_of_voxels(self):
        at = places(self.network.bounds, self.network.grids[1])
        x, y, z, logarithm = at[7, 0, 1].tolist()
        self.assertAlmostEqual(x, 0.875, places=6)  # 14 m of 16
        self.assertAlmostEqual(y, -0.9, places=6)  # 21.6 m of 24
        self.assertAlmostEqual(z, 0.5, places=6)
        self.assertAlmostEqual(logarithm, math.log((math.hypot(14.0, 21.6) + 1.0) / 25.0), places=5)

    def test_places_are_learnt_from_features_that_hold_them(self):
        heads = PlaceHeads(self.network)
        volumes = [torch.zeros(2, channels, *grid) for channels, grid in zip(self.network.channels[1:], self.network.grids)]
        for level, volume in enumerate(volumes):
            volume[:, :4] = getattr(heads, f"places{level}").permute(3, 0, 1, 2)
        for linear in heads.linear:
            torch.nn.init.zeros_(linear.bias)
            torch.nn.init.eye_(linear.weight)
        self.assertAlmostEqual(heads.loss(volumes).item(), 0.0, places=10)
        self.assertGreater(heads.loss([volume.flip(2) for volume in volumes]).item(), 0.5)

    def test_place_of_a_pixel(self):
        bins = torch.tensor([[[0, IGNORED, 31], [IGNORED] * 3]])
        right = torch.zeros(1, 3, 2, 3)
        right[:, 0], right[:, 1] = torch.tensor([[-1.0], [1.0]]), torch.tensor([-1.0, 0.0, 1.0])
        right[:, 2] = torch.tensor([[1 / 32, 9.0, 63 / 32], [9.0] * 3])  # the sky has no depth
        self.assertAlmostEqual(PixelHeads.error_of_place(right, bins).item(), 0.0, places=10)
        right[:, 2, 0, 0] += 2.0
        self.assertAlmostEqual(PixelHeads.error_of_place(right, bins).item(), 2.0, places=6)
        right[:, 0] += 1.0
        self.assertAlmostEqual(PixelHeads.error_of_place(right, bins).item(), 3.0, places=6)


class Calibration(unittest.TestCase):
    def test_shifts_undo_a_wrong_prior(self):
        torch.manual_seed(4)
        labels = (torch.rand(20000) < 0.1).long() + (torch.rand(20000) < 0.02).long()
        logits = 3.0 * torch.nn.functional.one_hot(labels, 3) + 1.5 * torch.randn(20000, 3)
        shifts, before, after = fit_shifts(logits + torch.tensor([0.0, 2.0, 3.0]), labels)
        right = fit_shifts(logits, labels)[2]
        self.assertLess(before, right - 10.0)
        self.assertAlmostEqual(after, right, delta=1.0)
        self.assertEqual(shifts[0].item(), 0.0)
        self.assertTrue(bool((shifts[1:] < -1.0).all()), shifts)
        moved = (logits + torch.tensor([0.0, 2.0, 3.0]) + shifts).argmax(1)
        self.assertAlmostEqual(miou_of(moved, labels, 3), after, places=6)


class Configs(Place):
    def config(self, **changes):
        sets = {name: {"first": 0, "count": 1} for name in ("train", "tune", "held_out")}
        path = self.place / "config.json"
        path.write_text(json.dumps({**sets, "steps": 10, "batch": 2, **changes}))
        return Config.load(path)

    def test_phases(self):
        config = self.config(phases=[{"start": 0}, {"start": 5, "lovasz": 3}])
        self.assertEqual([config.phase(step).lovasz for step in (0, 4, 5, 9)], [1.0, 1.0, 3.0, 3.0])
        self.assertEqual(config.identity(), self.config(steps=20).identity())
        self.assertNotEqual(config.identity(), self.config(batch=4).identity())

    def test_the_rate_rises_again_where_volumes_come_in(self):
        phases = [{"start": 0, "volumes": False}, {"start": 4}, {"start": 8, "lovasz": 2}]
        config = self.config(phases=phases, warm_up=2, steps=1000)
        warm = [round(rate(config, step), 2) for step in range(10)]
        self.assertEqual(warm, [0.5, 1.0, 1.0, 1.0, 0.5, 1.0, 1.0, 1.0, 1.0, 1.0])

    def test_faults_are_named(self):
        for changes, message in (
            ({"phases": [{"start": 1}]}, r"phases.*\[1\]"),
            ({"phases": []}, "phases"),
            ({"phases": [{"start": 0, "nonsense": 1}]}, "nonsense"),
            ({"nonsense": 1}, "nonsense"),
            ({"precision": "f16"}, "precision"),
            ({"workers": 3}, "multiple of the 3 workers"),
            ({"after": "config.json"}, "after.*itself"),
            ({"train": {"first": 0}}, "count"),
            ({"drawn": "never"}, "drawn"),
            ({"drawn": "beside", "workers": 2}, "workers"),
            ({"jitter": {"rigs": 1, "degrees": 1, "metres": 0.1, "share": 0.5}}, "jitter"),
            ({"jitter": {"rigs": 1}, "drawn": "beside"}, "degrees"),
            ({"minutes": 3, "workers": 2}, "minutes"),
            ({"tail": {"nonsense": 1}}, "nonsense"),
            ({"tail": {"precision": "f16"}}, "precision.*f16"),
        ):
            with self.subTest(changes), self.assertRaisesRegex(InputError, message):
                self.config(**changes)


if __name__ == "__main__":
    unittest.main()
