"""For every check a copy of a loss, broken in the one way that the check is there to notice."""

from __future__ import annotations

import copy
from typing import Any

import torch
from tensordict import NestedKey, TensorDict
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_sspl.objectives import ConsistencyLoss, PolicyDeviationLoss, SaLaDLoss, SynthesisLoss
from torchrl_sspl.objectives.base import LatentBatch, _valid

from .cases import CASES, Case

BY_NAME = {case.name: case for case in CASES}
BREAKS: list[tuple[str, Case, type]] = []


def breaks(check: str, case: str) -> Any:
    def register(kind: type) -> type:
        BREAKS.append((check, BY_NAME[case], kind))
        return kind

    return register


@breaks("parameters_can_be_reset", "salad")
class ResetsNothing(SaLaDLoss):
    def reset_parameters_recursive(self) -> None:
        pass


@breaks("unknown_key_is_a_value_error", "salad")
class AcceptsAnyKey(SaLaDLoss):
    def set_keys(self, **keys: NestedKey) -> None:
        super().set_keys(**{key: value for key, value in keys.items() if hasattr(self.tensor_keys, key)})


@breaks("default_keys_are_the_documented_ones", "salad")
class HasOtherDefaults(SaLaDLoss):
    def __init__(self, *nets: nn.Module, **options: Any) -> None:
        super().__init__(*nets, **options)
        self.set_keys(region="label")


@breaks("every_key_can_be_renamed", "salad")
class ReadsAFixedKey(SaLaDLoss):
    def set_keys(self, **keys: NestedKey) -> None:
        super().set_keys(**{**keys, "action": "action"})


@breaks("input_is_left_alone", "synthesis")
class WritesItsLatent(SynthesisLoss):
    def _read(self, tensordict: TensorDict) -> LatentBatch:
        batch = super()._read(tensordict)
        tensordict["latent"] = batch.latent.detach()
        return batch


@breaks("forward_leaves_no_gradient", "salad")
class GoesBackwardInside(SaLaDLoss):
    def _salad_terms(self, batch: LatentBatch) -> dict[str, Tensor]:
        terms = super()._salad_terms(batch)
        terms["loss_consistency"].backward(retain_graph=True)
        return terms


@breaks("each_term_moves_its_networks_only", "synthesis")
class LeaksIntoTheDynamics(SynthesisLoss):
    def _run(self, name: str, *inputs: Tensor, params: str = "online", method: str | None = None) -> Tensor:
        return super()._run(name, *inputs, params="online" if name == "dynamics" else params, method=method)


@breaks("sum_reaches_every_parameter_and_no_target", "salad")
class ForgetsATerm(SaLaDLoss):
    def _salad_terms(self, batch: LatentBatch) -> dict[str, Tensor]:
        terms = super()._salad_terms(batch)
        terms["loss_consistency"] = terms["loss_consistency"].detach()
        return terms


@breaks("parameters_are_not_repeated", "salad")
class ListsParametersTwice(SaLaDLoss):
    def parameters(self, recurse: bool = True) -> Any:
        yield from super().parameters(recurse)
        yield from super().parameters(recurse)


@breaks("state_dict_fits_a_fresh_loss", "salad")
class KeepsAMarginOutside(SaLaDLoss):
    def __init__(self, *nets: nn.Module, **options: Any) -> None:
        super().__init__(*nets, **options)
        margin = self.safety_margin
        del self.safety_margin
        self.register_buffer("safety_margin", margin, persistent=False)


@breaks("layers_can_be_shared", "salad")
class RepeatsSharedLayers(SaLaDLoss):
    def named_parameters(self, prefix: str = "", recurse: bool = True) -> Any:
        for name in self._networks_used:
            yield from self.get_submodule(f"{name}_params").named_parameters(name, recurse)


@breaks("keyword_call_equals_tensordict_call", "salad")
class SwapsItsOutputs(SaLaDLoss):
    def __init__(self, *nets: nn.Module, **options: Any) -> None:
        super().__init__(*nets, **options)
        self.out_keys = self.out_keys[::-1]

    def forward(self, tensordict: Any = None, **values: Tensor) -> Any:
        if tensordict is not None:
            return super().forward(tensordict)
        return tuple(reversed(super().forward(**values)))


@breaks("outputs_can_be_selected", "salad")
class ReturnsEverything(SaLaDLoss):
    def _pack(self, terms: dict[str, Tensor], tensordict: TensorDict) -> TensorDict:
        return TensorDict(terms)


@breaks("reductions_agree", "deviation")
class AlwaysMeans(PolicyDeviationLoss):
    def __init__(self, *nets: nn.Module, **options: Any) -> None:
        super().__init__(*nets, **{**options, "reduction": "mean"})


@breaks("weights_count_rows", "salad")
class IgnoresWeights(SaLaDLoss):
    use_prioritized_weights = False


@breaks("missing_target_updater_is_told", "salad")
class SaysNothing(SaLaDLoss):
    def __init__(self, *nets: nn.Module, **options: Any) -> None:
        super().__init__(*nets, **options)
        self._has_update_associated = dict.fromkeys(self._has_update_associated, True)


@breaks("target_updates_are_exact", "salad")
class TargetsAreAliases(SaLaDLoss):
    def __init__(self, *nets: nn.Module, **options: Any) -> None:
        super().__init__(*nets, **options)
        # A delayed weight that is none: it has the same storage.
        delayed = self._modules["target_encoder_params"]
        next(delayed.buffers()).data = next(self.encoder_params.parameters()).data


@breaks("casting_keeps_identity", "salad")
class CopiesItsNetworks(SaLaDLoss):
    def __init__(self, *nets: nn.Module, **options: Any) -> None:
        super().__init__(*copy.deepcopy(nets), **options)


@breaks("masked_rows_do_not_count", "salad")
class MasksTheOutputOnly(SaLaDLoss):
    def _read(self, tensordict: TensorDict) -> LatentBatch:
        batch = super()._read(tensordict.exclude(*self._loss_mask_keys()))
        batch.valid = _valid(tensordict, self._loss_mask_keys())
        return batch


@breaks("margins_can_be_scheduled", "salad")
class KeepsMarginsAsNumbers(SaLaDLoss):
    def _salad_terms(self, batch: LatentBatch) -> dict[str, Tensor]:
        held = self.safety_margin.clone()
        self.safety_margin.copy_(torch.tensor(3.0))
        terms = super()._salad_terms(batch)
        self.safety_margin.copy_(held)
        return terms


@breaks("exploration_is_off_inside", "synthesis")
class Explores(SynthesisLoss):
    def _synthesis_terms(self, batch: LatentBatch) -> dict[str, Tensor]:
        with set_exploration_type(ExplorationType.RANDOM):
            return super()._synthesis_terms(batch)


@breaks("networks_can_be_taken_out_and_put_back", "salad")
class ForgetsWhatIsPutBack(SaLaDLoss):
    def from_stateful_net(self, network_name: str, stateful_net: nn.Module) -> None:
        pass


@breaks("captures_as_one_graph", "deviation")
class AsksForAValue(PolicyDeviationLoss):
    def _deviation_terms(self, batch: LatentBatch) -> dict[str, Tensor]:
        terms = super()._deviation_terms(batch)
        if float(terms["loss_policy_deviation"].detach()) < 0.0:
            terms["loss_policy_deviation"] = terms["loss_policy_deviation"] + 1.0
        return terms


@breaks("targets_stay_out_of_the_graph", "salad")
class PreservesModuleState(SaLaDLoss):
    def _run(self, name: str, *inputs: Tensor, params: str = "online", method: str | None = None) -> Tensor:
        values = self.get_submodule(f"{'target_' * (params == 'target')}{name}_params")
        network = getattr(self, name)
        with values.to_module(network):
            return network(*inputs)


@breaks("networks_are_restored_after_an_exception", "salad")
class RestoresOnSuccessOnly(SaLaDLoss):
    def _run(self, name: str, *inputs: Tensor, params: str = "online", method: str | None = None) -> Tensor:
        values = self.get_submodule(f"{'target_' * (params == 'target')}{name}_params")
        network = getattr(self, name)
        with values.to_module(network, preserve_module_state=False):
            return network(*inputs)


@breaks("keys_and_metrics_are_fixed", "salad")
class ReportsWhatItFinds(SaLaDLoss):
    def _pack(self, terms: dict[str, Tensor], tensordict: TensorDict) -> TensorDict:
        if not bool((tensordict["region"] == 1).any()):
            terms.pop("safe_error")
        return TensorDict(terms)


@breaks("a_deep_copy_is_independent", "salad")
class CopiesShallowly(SaLaDLoss):
    def __deepcopy__(self, memo: dict) -> SaLaDLoss:
        return self


@breaks("masked_rows_do_not_count", "consistency")
class CountsAllRows(ConsistencyLoss):
    def _reduce(self, value: Tensor, batch: LatentBatch, mask: Tensor | None = None, *, worst: bool = False) -> Tensor:
        batch.valid = None
        return super()._reduce(value, batch, mask, worst=worst)


@breaks("weights_count_rows", "consistency")
class WeighsTwice(ConsistencyLoss):
    def _reduce(self, value: Tensor, batch: LatentBatch, mask: Tensor | None = None, *, worst: bool = False) -> Tensor:
        value = value if batch.weights is None else value * batch.weights
        return super()._reduce(value, batch, mask, worst=worst)


@breaks("keys_and_metrics_are_fixed", "consistency")
class ReportsTheErrorInU(ConsistencyLoss):
    def _pack(self, terms: dict[str, Tensor], tensordict: TensorDict) -> TensorDict:
        if bool((tensordict["region"] == 2).any()):
            terms["unsafe_dynamics_error"] = terms["dynamics_error"]
        return TensorDict(terms)
