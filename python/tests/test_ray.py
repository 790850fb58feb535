"""A Ray cluster of two nodes on this machine, one of which is killed in the middle."""

import logging
from dataclasses import replace

import numpy
import pytest
import ray
from ray.cluster_utils import Cluster

import voxcast
import voxcast.ray

FRAMES = 12


@pytest.fixture
def cluster():
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    cluster.second = cluster.add_node(num_cpus=1)
    cluster.wait_for_nodes()
    ray.init(address=cluster.address, log_to_driver=False, logging_level=logging.ERROR)
    yield cluster
    ray.shutdown()
    cluster.shutdown()


def test_a_node_is_lost_and_the_numbers_stay(cluster, model, heldout, scores, place, caplog):
    caplog.set_level(logging.INFO, "voxcast.ray")
    journal = place / "ray.jsonl"
    nodes = {node["NodeID"] for node in ray.nodes() if node["Alive"]}
    assert len(nodes) == 2
    told = []

    def kill(done: int, total: int) -> None:
        told.append((done, total))
        same = [record for record in caplog.records if "is the same on nodes" in record.message]
        if same and cluster.second is not None:
            # Both nodes have computed; one has a frame under way, or is about to get one.
            cluster.remove_node(cluster.second, allow_graceful=False)
            cluster.second = None

    report = voxcast.ray.evaluate(
        model, heldout, losses=True, resume=journal, check=FRAMES // 2, progress=kill
    )
    assert report.to_dict() == scores, "the numbers of a single process, to the last bit"
    assert told == [(done, FRAMES) for done in range(1, FRAMES + 1)]
    messages = [record.message for record in caplog.records]
    assert cluster.second is None, "a frame was compared before the end, and the node killed"
    assert any("is lost; frame" in message for message in messages), messages
    assert all(node in " ".join(messages) for node in nodes)
    assert len(journal.read_text().splitlines()) == FRAMES + 1

    # The driver's journal has everything: nothing is left for a cluster.
    again = voxcast.ray.evaluate(model, heldout, losses=True, resume=journal, progress=lambda *_: told.append(None))
    assert again.to_dict() == scores and None not in told


def test_scenes_are_run_and_a_node_that_computes_wrongly_is_found_out(cluster, model, place, monkeypatch):
    paths = [place / f"ray-scene-{seed}" for seed in range(3)]
    expected = {}
    for seed, path in enumerate(paths):
        scene = voxcast.Scene.street(model, seed)
        scene.save(path)
        rig = voxcast.Rig.build(model, scene)
        expected[str(path)] = voxcast.Session(model, rig, threads=1, logits=True, confidence=True).run(scene)
    results = {result.scene: result for result in voxcast.ray.run(model, paths, check=1)}
    assert {scene: result.digest for scene, result in results.items()} == {s: r.digest for s, r in expected.items()}
    assert all(result.classes.shape == tuple(model.grid) for result in results.values())
    for result in results.values():
        assert result.logits is None and result.confidence_occupied is None and result.confidence_class is None

    # What else may be asked for is that of a session, and compared between nodes as well.
    more = list(voxcast.ray.run(model, paths, logits=True, confidence=True, check=3))
    assert {result.scene for result in more} == set(expected)
    for result in more:
        for name in ("classes", "logits", "confidence_occupied", "confidence_class"):
            assert numpy.array_equal(getattr(result, name), getattr(expected[result.scene], name)), name

    class Faulty(voxcast.ray._Runner):
        """On the second node, what was asked for last comes out otherwise."""

        def compute(self, path: str):
            frame = super().compute(path)
            here = ray.get_runtime_context().get_node_id()
            return replace(frame, digests=(*frame.digests[:-1], frame.digests[-1] + here))

    monkeypatch.setattr(voxcast.ray, "_Runner", Faulty)
    for asked in ({}, {"confidence": True}):
        with pytest.raises(voxcast.MismatchError, match="ray-scene-0: nodes [0-9a-f]+ and [0-9a-f]+ disagree"):
            list(voxcast.ray.run(model, paths, check=1, **asked))


def test_errors_of_a_frame_are_the_callers(cluster, model, place):
    with pytest.raises(voxcast.FileError, match="nowhere") as raised:
        list(voxcast.ray.run(model, [place / "nowhere"]))
    assert raised.value.path == str(place / "nowhere")
    with pytest.raises(ValueError, match="threads: found 0"):
        voxcast.ray.evaluate(model, f"synthetic:{place / 'heldout'}", threads=0)
    assert voxcast.ray._spread(10, 3) == {0, 3, 6} and voxcast.ray._spread(2, 5) == {0, 1}
