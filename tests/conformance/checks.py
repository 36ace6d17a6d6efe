"""The checks that TorchRL applies to its own losses, each as a function that raises ``AssertionError``."""

from __future__ import annotations

import contextlib
import copy
import warnings
from collections.abc import Callable
from dataclasses import fields

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.objectives import HardUpdate, LossModule, SoftUpdate

from .cases import Case

Kind = Callable[..., LossModule]
CHECKS: dict[str, Callable[[Case, Kind], None]] = {}


def check(function: Callable[[Case, Kind], None]) -> Callable[[Case, Kind], None]:
    CHECKS[function.__name__] = function
    return function


def run(loss: nn.Module, data: TensorDict) -> TensorDict:
    """Forward with the same random numbers every time."""
    torch.manual_seed(3)
    return loss(data)


def total(output: TensorDict) -> Tensor:
    return sum(value.sum() for key, value in output.items() if key.startswith("loss_"))  # type: ignore[return-value]


def names(loss: LossModule) -> list[str]:
    """Networks of the loss."""
    return [
        name[:-7]
        for name, _ in loss.named_children()
        if name.endswith("_params") and not name.startswith("target_")
    ]


def targets(loss: LossModule) -> dict[str, Tensor]:
    return {name: value for name, value in loss.named_buffers() if name.startswith("target_")}


def moved(loss: LossModule) -> set[str]:
    """Networks some parameter of which has a gradient that is not zero."""
    return {
        name
        for name in names(loss)
        for value in loss.get_submodule(f"{name}_params").parameters()
        if value.grad is not None and bool((value.grad != 0).any())
    }


def held(loss: LossModule) -> list[tuple[int, ...]]:
    """Which tensors the networks hold."""
    return [tuple(id(value) for value in (*net.parameters(), *net.buffers())) for net in case_nets(loss)]


def same(first: TensorDict, second: TensorDict, skip: tuple[str, ...] = (), tolerance: float = 1e-6) -> None:
    assert set(first.keys()) == set(second.keys())
    for key, value in first.items():
        if key not in skip:
            assert torch.allclose(value, second[key], atol=tolerance, rtol=1e-5), key


def expect(condition: bool | Tensor, message: str) -> None:
    assert bool(condition), message


@check
def parameters_can_be_reset(case: Case, kind: Kind) -> None:
    loss = case.build(kind)
    before = {name: value.detach().clone() for name, value in loss.named_parameters() if value.ndim > 1}
    loss.reset_parameters_recursive()
    for name, value in loss.named_parameters():
        if name in before:
            expect(not torch.equal(value, before[name]), f"{name} was not reset")
    before = {name: value.clone() for name, value in targets(loss).items() if value.ndim > 1}
    loss.reset_parameters_recursive()
    for name, value in before.items():
        expect(not torch.equal(targets(loss)[name], value), f"{name} was not reset")


@check
def unknown_key_is_a_value_error(case: Case, kind: Kind) -> None:
    loss = case.build(kind)
    try:
        loss.set_keys(no_such_key="x")
    except ValueError as error:
        expect("no_such_key" in str(error), "the message does not name the key")
        return
    raise AssertionError("an unknown key was accepted")


@check
def default_keys_are_the_documented_ones(case: Case, kind: Kind) -> None:
    loss = case.build(kind)
    documented = "".join(kind.__doc__ or "" for kind in loss._AcceptedKeys.__mro__)
    for entry in fields(loss._AcceptedKeys):
        expect(getattr(loss.tensor_keys, entry.name) == entry.default, f"{entry.name} has another default")
        expect(f"{entry.name}: " in documented, f"{entry.name} is not documented")
    expect(loss.default_keys() == loss._AcceptedKeys(), "default_keys are others")


def _renamed(case: Case, loss: LossModule, renames: dict[str, object]) -> TensorDict:
    data = case.data()
    for entry, new in renames.items():
        old = getattr(loss.default_keys(), entry)
        if old not in data.keys(True):
            continue
        data.rename_key_(old, new)
        if ("next", old) in data.keys(True):
            data.rename_key_(("next", old), ("next", *(new if isinstance(new, tuple) else (new,))))
    return data


@check
def every_key_can_be_renamed(case: Case, kind: Kind) -> None:
    expected = run(case.build(kind), case.data())
    entries = [entry.name for entry in fields(case.loss._AcceptedKeys)]
    renames = [{name: f"my_{name}"} for name in entries] + [{name: ("my", name)} for name in entries]
    renames += [{name: f"my_{name}" for name in entries}, {name: ("my", name) for name in entries}]
    for rename in renames:
        loss = case.build(kind)
        loss.set_keys(**rename)
        for name, key in rename.items():
            expect(getattr(loss.tensor_keys, name) == key, f"{name} was not set")
        same(expected, run(loss, _renamed(case, loss, rename)))
        loss.set_keys(**dict.fromkeys(rename))
        same(expected, run(loss, case.data()))


@check
def input_is_left_alone(case: Case, kind: Kind) -> None:
    data = case.data()
    before = data.clone()
    run(case.build(kind), data)
    expect(set(data.keys(True, True)) == set(before.keys(True, True)), "entries were added or removed")
    expect((data == before).all(), "entries were changed")


@check
def forward_leaves_no_gradient(case: Case, kind: Kind) -> None:
    loss = case.build(kind)
    run(loss, case.data())
    expect(all(value.grad is None for value in loss.parameters()), "there is a gradient before backward")


@check
def each_term_moves_its_networks_only(case: Case, kind: Kind) -> None:
    loss = case.build(kind)
    output = run(loss, case.data())
    terms = {key for key, _ in output.items() if key.startswith("loss_")}
    expect(terms == set(case.reaches), f"terms are {terms}")
    for term in sorted(terms):
        loss.zero_grad()
        output[term].sum().backward(retain_graph=True)
        expect(moved(loss) == case.reaches[term], f"{term} moves {moved(loss)}, not {case.reaches[term]}")


@check
def sum_reaches_every_parameter_and_no_target(case: Case, kind: Kind) -> None:
    loss = case.build(kind)
    total(run(loss, case.data())).backward()
    reached = set().union(*case.reaches.values())
    for name in names(loss):
        for key, value in loss.get_submodule(f"{name}_params").named_parameters():
            if name in reached and not key.endswith(case.unreached):
                expect(value.grad is not None, f"{name}.{key} is not reached")
    for name, value in targets(loss).items():
        expect(value.grad is None, f"{name} has a gradient")
        expect(not value.requires_grad, f"{name} became trainable")
    expect(all("target_" not in name for name, _ in loss.named_parameters()), "a target is a parameter")


@check
def parameters_are_not_repeated(case: Case, kind: Kind) -> None:
    loss = case.build(kind)
    listed = [id(value) for value in loss.parameters()]
    expect(len(listed) == len(set(listed)), "a parameter is listed twice")
    nets = {id(value) for net in case_nets(loss) for value in net.parameters()}
    expect(nets <= set(listed), "a parameter of a network is missing")


def case_nets(loss: LossModule) -> list[nn.Module]:
    return [getattr(loss, name) for name in names(loss)]


@check
def state_dict_fits_a_fresh_loss(case: Case, kind: Kind) -> None:
    loss, fresh = case.build(kind), case.build(kind)
    with torch.no_grad():
        for value in [*loss.parameters(), *targets(loss).values()]:
            value.add_(0.01 * torch.randn_like(value))
    for name in loss._all_schedulable_buffers & dict(loss.named_buffers()).keys() - loss.__dict__.get("_left_out", set()):
        setattr(loss, name, float(getattr(loss, name)) + 0.25)
    fresh.load_state_dict(loss.state_dict())
    same(run(loss, case.data()), run(fresh, case.data()), tolerance=0.0)


class _Shares(nn.Module):
    """A network behind (or before) a layer that another network has too."""

    def __init__(self, net: nn.Module, layer: nn.Module, *, last: bool) -> None:
        super().__init__()
        self.net, self.layer, self.last = net, layer, last
        self.latent_dim, self.action_dim = 2, 1

    def forward(self, first: Tensor, *rest: Tensor) -> Tensor:
        return self.layer(self.net(first, *rest)) if self.last else self.net(self.layer(first), *rest)


@check
def layers_can_be_shared(case: Case, kind: Kind) -> None:
    if len(case.nets()) < 2:
        return

    def build(shared: bool) -> tuple[LossModule, list[nn.Module]]:
        nets = list(case.nets())
        torch.manual_seed(5)
        layer = nn.Linear(2, 2)
        layers = [layer, layer if shared else copy.deepcopy(layer)]
        for index, own in zip((-2, -1), layers, strict=True):
            nets[index] = _Shares(nets[index], own, last=case.takes.split()[index] == "encoder")
        torch.manual_seed(6)
        loss = kind(*nets, **case.options)
        loss._has_update_associated = dict.fromkeys(loss._has_update_associated, True)
        return loss, layers

    gradients = []
    for shared in (True, False):
        loss, layers = build(shared)
        listed = [id(value) for value in loss.parameters()]
        expect(len(listed) == len(set(listed)), "a shared parameter is listed twice")
        total(run(loss, case.data())).backward()
        grads = [layer.weight.grad for layer in (layers[:1] if shared else layers)]
        gradients.append(sum(grad for grad in grads if grad is not None))
    expect(torch.allclose(*gradients, rtol=1e-4, atol=1e-6), "a shared layer has another gradient")


@check
def keyword_call_equals_tensordict_call(case: Case, kind: Kind) -> None:
    loss = case.build(kind)
    data = case.data()
    expected = run(loss, data)
    flat = {"_".join(key) if isinstance(key, tuple) else key: value for key, value in data.items(True, True)}
    accepted = {"_".join(key) if isinstance(key, tuple) else key for key in loss.in_keys}
    torch.manual_seed(3)
    values = loss(**{key: value for key, value in flat.items() if key in accepted})
    values = values if isinstance(values, tuple) else (values,)
    expect(len(values) == len(loss.out_keys), "the number of outputs differs")
    for key, value in zip(loss.out_keys, values, strict=True):
        expect(torch.allclose(value, expected[key], atol=1e-6), f"{key} differs")


@check
def outputs_can_be_selected(case: Case, kind: Kind) -> None:
    loss = case.build(kind)
    key = sorted(case.reaches)[0]
    everything = run(loss, case.data())
    expected = everything[key]
    loss.select_out_keys(key)
    output = run(loss, case.data())
    expect(set(output.keys()) == {key}, f"received {set(output.keys())}")
    expect(torch.equal(output[key], expected), "the selected output differs")
    flat = {
        "_".join(key) if isinstance(key, tuple) else key: value
        for key, value in case.data().items(True, True)
    }
    accepted = {"_".join(key) if isinstance(key, tuple) else key for key in loss.in_keys}
    torch.manual_seed(3)
    value = loss(**{key: value for key, value in flat.items() if key in accepted})
    expect(
        isinstance(value, Tensor) and torch.allclose(value, expected),
        "the keyword call selects something else",
    )
    expect(loss.reset_out_keys() is loss, "reset_out_keys does not return the loss")
    expect(loss.out_keys == loss.out_keys_source, f"after the reset out_keys are {loss.out_keys}")
    expect(set(run(loss, case.data()).keys()) == set(everything.keys()), "the reset does not give all outputs again")


@check
def reductions_agree(case: Case, kind: Kind) -> None:
    output = {how: run(case.build(kind, reduction=how), case.data()) for how in (None, "mean", "sum", "none")}
    for key in case.reaches:
        for how in (None, "mean", "sum") if case.rows else output:
            expect(output[how][key].shape == (), f"{key} is no scalar under {how}")
        if not case.rows:
            return
        expect(output["none"][key].shape == case.data().batch_size, f"{key} has no row per sample")
        expect(torch.equal(output[None][key], output["mean"][key]), f"{key}: the default is not the mean")
        expect(
            torch.allclose(output["none"][key].sum(), output["sum"][key], rtol=1e-4), f"{key}: sum differs"
        )
    expect(
        any(not torch.allclose(output["mean"][key], output["sum"][key]) for key in case.reaches),
        "mean and sum are the same",
    )


@check
def weights_count_rows(case: Case, kind: Kind) -> None:
    loss, data = case.build(kind), case.data()
    expected = run(loss, data)
    same(expected, run(loss, data.clone().set("priority_weight", torch.ones(data.batch_size))))
    if not case.pointwise or not case.rows:
        return
    # A row of weight two counts as the same row twice.
    random = ("loss_off_manifold",)
    weighted = data.clone().set("priority_weight", 1.0 + (torch.arange(len(data)) == 1).float())
    twice = torch.cat([data, data[1:2]])
    skip = (*random, *(key for key, _ in expected.items() if not key.startswith("loss_")))
    same(run(loss, twice), run(loss, weighted), skip=skip)
    plain = case.build(kind)
    plain.use_prioritized_weights = False
    same(expected, run(plain, weighted))


@check
def missing_target_updater_is_told(case: Case, kind: Kind) -> None:
    loss = kind(*case.nets(), **case.options)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run(loss, case.data())
    told = any("No target network updater" in str(entry.message) for entry in caught)
    expect(told == bool(targets(loss)), f"told: {told}, targets: {len(targets(loss))}")


@check
def target_updates_are_exact(case: Case, kind: Kind) -> None:
    for soft in (True, False):
        loss = case.build(kind)
        if not targets(loss):
            return
        updater = SoftUpdate(loss, tau=0.1) if soft else HardUpdate(loss, value_network_update_interval=1)
        before = {name: value.clone() for name, value in targets(loss).items()}
        total(run(loss, case.data())).backward()
        with torch.no_grad():
            for value in loss.parameters():
                value.add_(1.0)
        for _ in range(1 if soft else 2):
            updater.step()
        online = dict(loss.named_parameters())
        compared = 0
        for name, value in targets(loss).items():
            source = online.get(name.removeprefix("target_"))
            if source is not None:
                expected = before[name] + (0.1 if soft else 1.0) * (source - before[name])
                expect(
                    torch.allclose(value, expected, atol=1e-6),
                    f"{name} after a {'soft' if soft else 'hard'} update",
                )
                compared += 1
        expect(compared > 0, "no target was compared")


@check
def casting_keeps_identity(case: Case, kind: Kind) -> None:
    nets = case.nets()
    loss = kind(*nets, **case.options)
    loss._has_update_associated = dict.fromkeys(loss._has_update_associated, True)
    held = {id(value) for value in loss.parameters()}
    loss.to(torch.float64).to("cpu")
    expect({id(value) for value in loss.parameters()} == held, "parameters were replaced")
    own = {id(value) for net in nets if net is not None for value in net.parameters()}
    expect(own <= held, "the parameters are not those of the networks")
    expect(all(value.dtype == torch.float64 for value in loss.parameters()), "a parameter was not cast")
    data = case.data().apply(lambda value: value.double() if value.is_floating_point() else value)
    output = run(loss, data)
    expect(
        all(value.dtype == torch.float64 for key, value in output.items() if "loss_" in key),
        "the output is not cast",
    )


@check
def masked_rows_do_not_count(case: Case, kind: Kind) -> None:
    if not case.rows:
        return
    data = case.data()
    valid = torch.arange(len(data)) % 4 != 3
    expected = run(case.build(kind), data[valid])
    poisoned = data.clone()
    for value in poisoned.values(True, True):
        if value.is_floating_point():
            value[~valid] = float("nan")
    for mask in (valid, valid[:, None]):
        loss = case.build(kind)
        masked = poisoned.clone().set(("collector", "mask"), mask)
        output = run(loss, masked)
        same(expected, output, skip=("loss_off_manifold",), tolerance=1e-5)
        total(output).backward()
        expect(
            all(value.grad is None or value.grad.isfinite().all() for value in loss.parameters()),
            "a masked NaN reached the gradient",
        )
        own = case.build(kind)
        own.loss_mask_key = ("mine", "ok")
        same(output, run(own, poisoned.clone().set(("mine", "ok"), mask)))


@check
def margins_can_be_scheduled(case: Case, kind: Kind) -> None:
    loss = case.build(kind)
    for name in ("safety_margin", "dynamics_margin"):
        held = loss.get_buffer(name)
        setattr(loss, name, 0.625)
        expect(loss.get_buffer(name) is held, f"{name} was replaced")
        expect(isinstance(getattr(loss, name), Tensor) and float(held) == 0.625, f"{name} was not set")
    given = case.build(case.loss, safety_margin=0.625, dynamics_margin=0.625)
    same(run(given, case.data()), run(loss, case.data()))


@check
def exploration_is_off_inside(case: Case, kind: Kind) -> None:
    seen = []

    class Recorder(nn.Module):
        def __init__(self, net: nn.Module) -> None:
            super().__init__()
            self.net = net

        def forward(self, *inputs: Tensor) -> Tensor:
            seen.append(exploration_type())
            return self.net(*inputs)

        def matrix(self) -> Tensor:
            seen.append(exploration_type())
            return self.net.matrix()

    nets = list(case.nets())
    nets[-1] = Recorder(nets[-1])
    loss = kind(*nets, **case.options)
    loss._has_update_associated = dict.fromkeys(loss._has_update_associated, True)
    from torchrl.envs.utils import set_exploration_type

    with set_exploration_type(ExplorationType.RANDOM):
        run(loss, case.data())
    expect(seen and set(seen) == {ExplorationType.DETERMINISTIC}, f"received {set(seen)}")


@check
def networks_can_be_taken_out_and_put_back(case: Case, kind: Kind) -> None:
    loss = case.build(kind)
    for name in names(loss):
        net = loss.get_stateful_net(name, copy=True)
        params = loss.get_submodule(f"{name}_params")
        expect(net is not getattr(loss, name), f"{name} is no copy")
        for a, b in zip(net.parameters(), params.parameters(), strict=True):
            expect(torch.equal(a, b), f"{name} came out with other weights")
        net = copy.deepcopy(net)
        for value in net.parameters():
            value.data.add_(0.01)
        loss.from_stateful_net(name, net)
        for a, b in zip(net.parameters(), params.parameters(), strict=True):
            expect(torch.equal(a, b), f"{name} was not put back")
    total(run(loss, case.data())).backward()


@check
def captures_as_one_graph(case: Case, kind: Kind) -> None:
    import torch._dynamo

    torch._dynamo.reset()
    loss = case.build(kind)
    expected = run(loss, case.data())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # Capture only; the same with code generation is a slow test.
        try:
            output = run(torch.compile(loss, fullgraph=True, backend="eager"), case.data())
        except torch._dynamo.exc.TorchDynamoException as error:
            raise AssertionError("the graph breaks") from error
    same(expected, output)
    expect(list(output.keys()) == list(expected.keys()), "another order of keys")


@check
def targets_stay_out_of_the_graph(case: Case, kind: Kind) -> None:
    loss = case.build(kind)
    before = held(loss)
    for _ in range(2):
        total(run(loss, case.data())).backward()
        # Those of the container: a bad swap replaces its leaves and leaves the registered buffers.
        leaves = [
            value
            for name, module in loss.named_children()
            if name.startswith("target_")
            for value in module.values(True, True)
        ]
        expect(not any(value.requires_grad for value in leaves), "a target became trainable")
        expect(held(loss) == before, "a network was left on other weights")
        expect(all(value.requires_grad for value in loss.parameters()), "a parameter was left frozen")


class _Failure(Exception):
    pass


@check
def networks_are_restored_after_an_exception(case: Case, kind: Kind) -> None:
    class Failing(nn.Module):
        def __init__(self, net: nn.Module) -> None:
            super().__init__()
            self.net, self.calls, self.after = net, 0, 10**9
            self.latent_dim, self.action_dim = 2, 1

        def forward(self, *inputs: Tensor) -> Tensor:
            self.calls += 1
            if self.calls > self.after:
                raise _Failure
            return self.net(*inputs)

        def matrix(self) -> Tensor:
            raise _Failure

    for index in range(len(case.nets())):
        # Every call of every network fails once; the delayed weights are among them.
        for after in range(4):
            nets = list(case.nets())
            if nets[index] is None:
                continue
            if hasattr(nets[index], "sequence"):
                continue  # its entry points are methods; the networks behind it fail in its place
            nets[index] = failing = Failing(nets[index])
            loss = kind(*nets, **case.options)
            loss._has_update_associated = dict.fromkeys(loss._has_update_associated, True)
            with torch.no_grad():
                for value in targets(loss).values():
                    value.add_(1.0)
            failing.after, before = after, held(loss)
            with contextlib.suppress(_Failure):
                run(loss, case.data())
            expect(held(loss) == before, "a network was left on other weights")


@check
def keys_and_metrics_are_fixed(case: Case, kind: Kind) -> None:
    loss = case.build(kind)
    seen = set()
    for code in (None, 0, 1, 2):
        data = case.data()
        if code is not None:
            data["region"] = torch.full_like(data["region"], code)
        output = run(loss, data)
        seen.add(tuple(output.keys()))
        for key, value in output.items():
            expect(value.isfinite().all(), f"{key} is not finite")
            expect(isinstance(key, str), f"{key} is nested")
            if not key.startswith("loss"):
                expect(
                    not value.requires_grad and value.shape == (), f"metric {key} is attached or no scalar"
                )
    expect(len(seen) == 1, "the keys vary with the data")
    expect(set(seen.pop()) == set(loss.out_keys), "out_keys do not say what comes out")


@check
def a_deep_copy_is_independent(case: Case, kind: Kind) -> None:
    loss = case.build(kind)
    clone = copy.deepcopy(loss)
    expected = run(loss, case.data())
    same(expected, run(clone, case.data()))
    with torch.no_grad():
        for value in clone.parameters():
            value.add_(0.5)
    same(expected, run(loss, case.data()))
