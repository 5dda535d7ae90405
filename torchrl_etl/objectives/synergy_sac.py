"""SAC with a policy over synergies and critics on muscle actions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives import SACLoss

from torchrl_etl.modules import SynergyMap
from torchrl_etl.objectives.checks import check_parts, warn_of_previous_action
from torchrl_etl.objectives.sac import LeanSACLoss, call

__all__ = ["SynergySACLoss"]


class SynergySACLoss(LeanSACLoss):
    """SAC in synergy space with critics on the executed action.

    The actor outputs coefficients z^a; the critics estimate Q(s, a). Coefficients that the loss
    draws (actor loss, bootstrap target) pass through the current decoder. For replayed transitions
    the critics read the ``action`` that was executed. So the critics' targets stay correct while
    the decoder changes, and the actor loss can train the decoder on the task's reward.

    Entropy is measured over the coefficients and the action given them: the decoder's
    :meth:`~torchrl_etl.modules.SynergyMap.log_slope` corrects for how far the action moves with
    the residual. Otherwise noise that the action's bounds suppress would count. If the residual's
    noise has a fixed size, set ``entropy_dims``: only the coefficients' entropy counts then,
    without the correction. The policy could change the rest only by keeping muscles off their
    bounds.

    Equation: section 4.2, a = Dec(z^a); SAC otherwise as in TorchRL, without a state-value network.

    Deviates: Eq. 10 alone brings no reward to the decoder (it regresses Dec(z) on a = Dec(z));
    with ``train_decoder=True`` the actor loss's gradient also reaches the decoder.

    Args:
        actor_network (ProbabilisticTensorDictSequential): writes the coefficients.
        qvalue_network (TensorDictModule): reads the observation and the decoded action.
        decoder (SynergyMap): reads the actor's sample, writes the critics' action.

    Keyword Args:
        train_decoder (bool): let ``loss_actor`` reach the decoder. Default: ``True``.
        **kwargs: see :class:`~torchrl_etl.objectives.LeanSACLoss`; ``action_spec`` is the unbatched
            spec of the coefficients.

    Keys:
        as in SACLoss, but the action is the executed one that the critics read (root entry
        [*, n]); recorded coefficients are not read. Like SACLoss, it writes ``td_error`` [*] into
        its input.

    Raises:
        TypeError: if the decoder is not a SynergyMap, or a ``value_network`` is given.
        ValueError: if the decoder does not map the actor's sample to the critics' action, or the
            critics read the sample itself; for an unknown reduction.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_etl.modules import SynergyDecoder, make_actor, make_critic
        >>> from torchrl_etl.objectives import SynergySACLoss
        >>> decoder = SynergyDecoder(num_synergies=2, action_dim=6)
        >>> loss = SynergySACLoss(
        ...     make_actor({"observation": 3}, decoder.synergy_spec, out_key="synergy"),
        ...     make_critic({"observation": 3, "action": 6}),
        ...     decoder,
        ...     action_spec=decoder.synergy_spec,
        ... )
        >>> batch = TensorDict(
        ...     {
        ...         "observation": torch.randn(4, 3),
        ...         "action": torch.zeros(4, 6),
        ...         "next": {
        ...             "observation": torch.randn(4, 3),
        ...             "reward": torch.zeros(4, 1),
        ...             "done": torch.zeros(4, 1, dtype=torch.bool),
        ...             "terminated": torch.zeros(4, 1, dtype=torch.bool),
        ...         },
        ...     },
        ...     [4],
        ... )
        >>> sorted(key for key in loss(batch).keys() if key.startswith("loss_"))
        ['loss_actor', 'loss_alpha', 'loss_qvalue']
    """

    @dataclass
    class _AcceptedKeys(SACLoss._AcceptedKeys):
        """SACLoss's keys; ``action`` is where the loss puts the coefficients it draws.

        Attributes:
            action (NestedKey): set to the actor's own key at construction; the default is
                ``"synergy"``.
        """

        action: NestedKey = "synergy"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys

    decoder_network: SynergyMap
    decoder_network_params: TensorDictParams
    target_decoder_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule,
        decoder: SynergyMap,
        *,
        train_decoder: bool = True,
        **kwargs: Any,
    ) -> None:
        check_parts("decoder", decoder, SynergyMap, outputs=1)
        sampled, decoded = list(actor_network.dist_sample_keys), list(decoder.out_keys)
        if (
            list(decoder.in_keys) != sampled
            or len(decoded) != 1
            or decoded[0] not in qvalue_network.in_keys
        ):
            raise ValueError(
                f"The decoder maps {list(decoder.in_keys)} to {decoded}, the actor samples "
                f"{sampled} and the critic reads {list(qvalue_network.in_keys)}; the decoder's one "
                "input must be the actor's sample and its one output the critic's action."
            )
        warn_of_previous_action(f"The critic of {type(self).__name__}", decoded)
        self.decoded_key: NestedKey = decoded[0]  # first: SACLoss collects its in-keys when built
        super().__init__(actor_network, qvalue_network, **kwargs)
        self.train_decoder = train_decoder
        self.convert_to_functional(decoder, "decoder_network", create_target_params=False)

    def set_keys(self, **kwargs: NestedKey | None) -> None:
        """See :meth:`torchrl.objectives.common.LossModule.set_keys`.

        Raises:
            ValueError: if ``action`` is a key that the critics read.
        """
        super().set_keys(**kwargs)
        if self.tensor_keys.action in self.qvalue_network.in_keys:
            raise ValueError(
                f"The actor writes its sample to {self.tensor_keys.action!r}, which the critic "
                f"reads (it reads {list(self.qvalue_network.in_keys)}), so replayed and fresh "
                "actions would be confused; let the critic read only the decoded action."
            )

    def _set_in_keys(self) -> None:
        observed = (
            *self.actor_network.in_keys,
            *(key for key in self.qvalue_network.in_keys if key != self.decoded_key),
        )
        ends = (self.tensor_keys.reward, self.tensor_keys.done, self.tensor_keys.terminated)
        following = (unravel_key(("next", key)) for key in (*observed, *ends))
        self._in_keys = list(dict.fromkeys((*observed, self.decoded_key, *following)))

    def _sample(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        synergy, log_prob = super()._sample(tensordict)
        if self.entropy_dims is not None:
            return synergy, log_prob
        params = self.decoder_network_params
        params = params if self.train_decoder else params.detach()
        with params.to_module(self.decoder_network, preserve_module_state=False):
            return synergy, log_prob - self.decoder_network.log_slope(synergy)

    def _at(self, tensordict: TensorDictBase, action: Tensor) -> TensorDictBase:
        inputs = tensordict.select(*self.qvalue_network.in_keys, strict=False)
        return inputs.set(self.decoded_key, self._decode(action))

    def _decode(self, synergy: Tensor) -> Tensor:
        decoder = self.decoder_network
        weights = self._weights("decoder_network", detached=not self.train_decoder)
        inputs = TensorDict({decoder.in_keys[0]: synergy}, synergy.shape[:-1])
        return call(decoder, weights, inputs, self.decoded_key)
