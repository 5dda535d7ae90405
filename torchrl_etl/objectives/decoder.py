"""Fine-tuning the synergy decoder on recorded pairs (Eq. 10)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torchrl.objectives.common import LossModule

from torchrl_etl.checks import check_choice, check_width
from torchrl_etl.functional import reconstruction_loss
from torchrl_etl.objectives.checks import check_parts, read, warn_of_previous_action

__all__ = ["DecoderLoss"]


class DecoderLoss(LossModule):
    r"""Squared error between the decoded synergy and the action recorded with it.

    Equation: 10

    Keys:
        reads ``synergy`` [*, d] (or [*, d+n], see :class:`~torchrl_etl.modules.SynergyDecoder`)
        and ``action`` [*, n]; writes ``loss_decoder``. The batch is read at the keys set with
        :meth:`set_keys`, whatever the decoder's own keys are.

    Deviates: only in its use. The recorded action *is* ``Dec(synergy)`` of the decoder that acted.
        So the gradient is zero on fresh pairs, pulls back to old outputs on stale ones, and
        carries no reward to the decoder. As the only fine-tuning signal this is the paper's literal
        reading. Next to an actor loss through the decoder it is a distillation term that keeps the
        synergies from drifting.

    Args:
        decoder (TensorDictModule): synergy → action; first in key and first out key are used.

    Keyword Args:
        reduction (str): ``"mean"``, ``"sum"`` or ``"none"``. Default: ``"mean"``.

    Raises:
        ValueError: for an unknown reduction.
        TypeError: if ``decoder`` is not a TensorDict module.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_etl.modules import SynergyDecoder
        >>> from torchrl_etl.objectives import DecoderLoss
        >>> loss = DecoderLoss(SynergyDecoder(num_synergies=4, action_dim=39))
        >>> batch = TensorDict({"synergy": torch.zeros(8, 4), "action": torch.ones(8, 39)}, [8])
        >>> loss(batch)["loss_decoder"].backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that :meth:`set_keys` can change.

        Attributes:
            synergy (NestedKey): recorded synergy coefficients. Default: ``"synergy"``.
            action (NestedKey): action recorded with them. Default: ``"action"``.
        """

        synergy: NestedKey = "synergy"
        action: NestedKey = "action"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys

    decoder: TensorDictModuleBase
    decoder_params: TensorDictParams
    target_decoder_params: TensorDictParams

    def __init__(
        self, decoder: TensorDictModuleBase, *, reduction: Literal["mean", "sum", "none"] = "mean"
    ) -> None:
        check_choice("reduction", reduction, ("mean", "sum", "none"))
        check_parts("decoder", decoder, TensorDictModuleBase, outputs=1)
        super().__init__()
        self.reduction = reduction
        self.convert_to_functional(decoder, "decoder")
        self._set_in_keys()
        self.out_keys = ["loss_decoder"]

    def _set_in_keys(self) -> None:
        self.in_keys = [self.tensor_keys.synergy, self.tensor_keys.action]
        warn_of_previous_action(type(self).__name__, self.in_keys)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The entries listed under ``Keys``, for a batch of any size, which is not modified."""
        name, keys = type(self).__name__, self.tensor_keys
        synergy = read(name, tensordict, keys.synergy).detach()
        action = read(name, tensordict, keys.action).detach()
        inputs = TensorDict({self.decoder.in_keys[0]: synergy}, synergy.shape[:-1])
        with self.decoder_params.to_module(self.decoder, preserve_module_state=False):
            decoded = self.decoder(inputs).get(self.decoder.out_keys[0])
        check_width(decoded.shape[-1], action=action)
        loss = reconstruction_loss(decoded, action)
        return TensorDict({"loss_decoder": self._reduce_loss(loss, tensordict)})
