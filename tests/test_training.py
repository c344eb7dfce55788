"""PhysicsLoss in training loops: gradients from anywhere, precision, recomputation, several processes, compiled code."""

import copy

import pytest
import torch
from torch import nn
from torch.utils.checkpoint import checkpoint

from physpose_torch import se3
from physpose_torch.config import PhysicsConfig, Smoothing
from physpose_torch.contacts import SUPPORT_SLOPE
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.losses import PhysicsLoss
from physpose_torch.report import physics_report
from physpose_torch.scene import Scene

N_BODIES = 6


class Mover(nn.Module):
    """Moves coarse poses by what a small network says, as pose refiners do; it starts as the identity."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(8, 32), nn.Tanh(), nn.Linear(32, 6))
        nn.init.zeros_(self.layers[-1].weight)
        nn.init.zeros_(self.layers[-1].bias)

    def forward(self, features, coarse):
        step = 0.1 * self.layers(features).to(coarse)
        with torch.autocast(coarse.device.type, enabled=False):
            return se3.retract(coarse, step)


def a_network(seed=0):
    """A network that has left the identity, so that every weight has a gradient."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = Mover()
        nn.init.normal_(network.layers[-1].weight, std=0.05)
    return network


def features_of(n, seed=0):
    return torch.randn(n, 8, generator=torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def pile(table, box, can, angle):
    """Scene and poses (4, 4, 4), float32: sunk into the table, into each other, and one in the air."""
    poses = table.poses((0, 0, 0.012), (0.06, 0.01, 0.035), (0.03, 0.03, -0.01), (-0.2, 0, 0.06, (0, 0, 1)))
    return Scene.tabletop([box, can, angle, box], table.plane), poses.float()


def gradients_of(network, features, coarse, scene):
    network.zero_grad()
    value = PhysicsLoss()(network(features, coarse), scene).total.mean()
    value.backward()
    return value.detach(), [p.grad.clone() for p in network.parameters()]


# ---- gradients from anywhere


def wild_poses(table, seed):
    """Random rotations; far away, behind the camera, in its centre, all in one place, deep under the table, about right."""
    draw = torch.Generator().manual_seed(seed)
    where = torch.randn(N_BODIES, 3, generator=draw, dtype=torch.float64)
    t = table.poses(*((0.05 * x, 0.05 * y, 0.02) for x, y, _ in where.tolist()))[:, :3, 3]
    kind = torch.randint(6, (N_BODIES,), generator=draw)[:, None]
    for k, other in enumerate((1e3 * where, -t, torch.zeros_like(t), t[:1].expand_as(t), t - table.up * where.abs())):
        t = torch.where(kind == k, other, t)
    turn = torch.randn(N_BODIES, 3, generator=draw, dtype=torch.float64) * 2
    return se3.from_rotation_translation(se3.exp_so3(turn), t)


@pytest.mark.parametrize("form", ["support", "paper"])
@pytest.mark.parametrize("kind", ["ring", "gaussian", "gumbel", "none"])
def test_gradients_from_wild_poses_are_finite_and_no_longer_than_the_contacts_allow(
    kind, form, dtype, table, box, can, angle
):
    """A pair of bodies pushes with at most its weight, and the ground pulls with at most its own over the least slope."""
    bodies = [box, can, angle, box, can, angle]
    scene = Scene.tabletop(bodies, table.plane)
    config = PhysicsConfig(gravity=form, smoothing=Smoothing(kind))
    most = config.collision_weight * len(bodies) + config.gravity_weight / SUPPORT_SLOPE
    pushed = 0
    for seed in range(12):
        poses = wild_poses(table, seed).to(dtype).requires_grad_()
        terms = PhysicsLoss(config)(poses, scene, measured=wild_poses(table, seed + 100).to(dtype))
        physics = terms.total - terms.pose
        (gradient,) = torch.autograd.grad(physics.sum(), poses, retain_graph=True)
        (whole,) = torch.autograd.grad(terms.total.sum(), poses)
        assert all(bool(term.isfinite().all()) for term in terms)
        assert bool(gradient.isfinite().all())
        assert bool(whole.isfinite().all())
        assert float(torch.linalg.vector_norm(gradient[:, :3, 3], dim=1).max()) <= most
        pushed += int((gradient != 0).flatten(1).any(1).sum())
    assert pushed > 20  # they were not all out of reach


def test_a_network_that_starts_as_the_identity_gets_a_finite_gradient(pile):
    """The exponential map at zero, where angles have no direction."""
    scene, coarse = pile
    network = Mover()
    _, gradients = gradients_of(network, features_of(len(coarse)), coarse, scene)
    assert all(bool(g.isfinite().all()) for g in gradients)
    assert bool(gradients[-1][:3].any())
    assert bool(gradients[-1][3:].any())


def test_training_with_the_loss_alone_gets_objects_out_of_the_table_and_down_to_it(pile):
    scene, coarse = pile
    network, features = Mover(), features_of(len(coarse))
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    before = physics_report(coarse, scene)
    loss = PhysicsLoss()
    for _ in range(150):
        optimizer.zero_grad()
        loss(network(features, coarse), scene).total.mean().backward()
        optimizer.step()
    after = physics_report(network(features, coarse).detach(), scene)
    assert float(before.penetration.max()) > 0.01
    assert float(before.gap.max()) > 0.03
    assert float(after.penetration.max()) < 0.001
    assert float(after.gap.max()) < 0.002


# ---- autocast


def test_under_autocast_the_loss_of_a_network_is_that_of_single_precision_but_for_the_networks_rounding(pile):
    scene, coarse = pile
    network, features = a_network(), features_of(len(coarse))
    plain, expected = gradients_of(network, features, coarse, scene)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert network.layers(features).dtype == torch.bfloat16
        cast, gradients = gradients_of(network, features, coarse, scene)
    assert cast.dtype == torch.float32
    assert float(cast) == pytest.approx(float(plain), rel=0.02)
    for a, b in zip(gradients, expected, strict=True):
        assert float((a - b).norm()) < 0.1 * float(b.norm())


def test_poses_put_together_under_autocast_are_refused_with_the_remedy(pile):
    scene, coarse = pile
    turn = torch.full((len(coarse), 6), 0.1)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        poses = se3.retract(coarse, turn)
        with pytest.raises(InvalidInputError, match=r"not rigid.*autocast\(device_type, enabled=False\)"):
            PhysicsLoss()(poses, scene)
    with pytest.raises(InvalidInputError, match=r"half precision"):
        PhysicsLoss()(se3.retract(coarse, turn).bfloat16(), scene)
    PhysicsLoss()(se3.retract(coarse, turn), scene)


# ---- gradient checkpointing


def test_gradient_checkpointing_changes_no_gradient(pile):
    scene, coarse = pile
    network, features, loss = a_network(), features_of(len(coarse)), PhysicsLoss()
    value, expected = gradients_of(network, features, coarse, scene)
    calls = []

    def cost(features):
        calls.append(None)
        return loss(network(features, coarse), scene).total.mean()

    network.zero_grad()
    again = checkpoint(cost, features, use_reentrant=False)
    assert len(calls) == 1
    again.backward()
    assert len(calls) == 2  # worked out anew on the way back
    assert torch.equal(again.detach(), value)
    assert all(torch.equal(p.grad, g) for p, g in zip(network.parameters(), expected, strict=True))


# ---- two processes


def two_scenes():
    """Two scenes of two objects each, and coarse poses (2, 2, 4, 4); what a worker process can build for itself."""
    box, can = Body.box((0.1, 0.06, 0.04), label="box"), Body.cylinder(0.03, 0.08, label="can")
    plane = Plane(torch.tensor([0.0, 0.0, -1.0]), torch.tensor(-0.8))  # seen from straight above
    coarse = torch.eye(4).repeat(2, 2, 1, 1)
    coarse[:, :, :3, 3] = torch.tensor([[[0, 0, 0.79], [0.05, 0, 0.78]], [[0, 0, 0.75], [0.1, 0, 0.765]]])
    return [Scene.tabletop([box, can], plane) for _ in range(2)], coarse


def train_on_one_scene(rank, store, out):
    """A worker: its scene's loss through DDP; its gradients go to a file."""
    torch.set_num_threads(1)
    torch.distributed.init_process_group("gloo", init_method=f"file://{store}", rank=rank, world_size=2)
    try:
        scenes, coarse = two_scenes()
        network = nn.parallel.DistributedDataParallel(a_network(seed=rank))  # rank 0's weights count
        _, gradients = gradients_of(network, features_of(4)[2 * rank : 2 * rank + 2], coarse[rank], scenes[rank])
        torch.save(gradients, f"{out}{rank}.pt")
    finally:
        torch.distributed.destroy_process_group()


@pytest.mark.slow  # two processes import everything
@pytest.mark.skipif(not torch.distributed.is_available(), reason="torch without distributed")
def test_two_processes_get_the_gradient_of_the_joint_batch(tmp_path):
    scenes, coarse = two_scenes()
    _, expected = gradients_of(a_network(), features_of(4), coarse.flatten(0, 1), Scene.cat(scenes))
    torch.multiprocessing.spawn(train_on_one_scene, (tmp_path / "store", tmp_path / "gradients"), nprocs=2)
    for rank in range(2):
        gradients = torch.load(tmp_path / f"gradients{rank}.pt")
        for a, b in zip(gradients, expected, strict=True):
            assert bool(b.any())
            torch.testing.assert_close(a, b)


# ---- torch.compile


@pytest.fixture
def fresh_dynamo():
    torch._dynamo.reset()
    yield
    torch._dynamo.reset()


def test_compiled_training_gives_the_same_and_breaks_once_whatever_touches(pile, fresh_dynamo):
    """The shapes within depend on what is near what: other contacts must not mean other graphs."""
    scene, coarse = pile
    network, features, loss = a_network(), features_of(len(coarse)), PhysicsLoss()
    graphs = []

    def keep(graph, _):
        graphs.append(graph)
        return graph

    def cost(features, coarse):
        return loss(network(features, coarse), scene).total.mean() * 2.0

    compiled = torch.compile(cost, backend=keep)
    contacts = set()
    for shift in (0.0, 0.01, 0.02, 0.2):
        moved = coarse.clone()
        moved[1, 0, 3] += shift
        network.zero_grad()
        expected = cost(features, moved)
        expected.backward()
        gradients = [p.grad.clone() for p in network.parameters()]
        network.zero_grad()
        value = compiled(features, moved)
        value.backward()
        assert torch.equal(value, expected)
        assert all(torch.equal(p.grad, g) for p, g in zip(network.parameters(), gradients, strict=True))
        contacts.add(round(float(expected.detach()), 4))
    assert len(contacts) == 4
    assert len(graphs) == 2  # before the loss, and after it
    torch._dynamo.reset()
    explained = torch._dynamo.explain(cost)(features, coarse)
    assert explained.graph_break_count == 1


def test_a_module_can_be_copied_and_compiled_whole(pile, fresh_dynamo):
    scene, coarse = pile
    loss = copy.deepcopy(PhysicsLoss())
    compiled = torch.compile(loss, backend="aot_eager")
    leaves = [coarse.clone().requires_grad_() for _ in range(2)]
    for f, leaf in zip((loss, compiled), leaves, strict=True):
        f(leaf, scene, measured=coarse).total.sum().backward()
    assert torch.equal(leaves[0].grad, leaves[1].grad)
