"""SAC whose policy speaks synergies and whose critics see muscles."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from tensordict.utils import NestedKey
from torchrl.objectives import SACLoss

__all__ = ["SynergySACLoss"]


class SynergySACLoss(SACLoss):
    """SAC in synergy space with critics on the executed action.

    The actor emits coefficients z^a; the critics value Q(s, a). Where the loss draws fresh
    coefficients (actor loss, bootstrap target) they pass through the current decoder; where a
    transition is replayed, the critics see the ``action`` that was executed. Hence the critics'
    targets stay right while the decoder moves, and the actor loss can carry the task's reward
    into the decoder.

    Equation: section 4.2, a = Dec(z^a); SAC otherwise as in TorchRL.

    Deviates: Eq. 10 alone brings no reward to the decoder (it regresses Dec(z) on a = Dec(z));
    with ``train_decoder=True`` the actor loss's gradient also reaches the decoder.

    Args:
        actor_network (ProbabilisticTensorDictSequential): writes the coefficients.
        qvalue_network (TensorDictModule): reads the observation and the decoded action.
        decoder (TensorDictModule): reads the actor's sample, writes the critics' action.

    Keyword Args:
        train_decoder (bool): let ``loss_actor`` reach the decoder. Default: ``True``.
        **kwargs: see :class:`torchrl.objectives.SACLoss`; give ``action_spec`` unbatched, of the
            coefficients.

    Keys:
        those of SACLoss, and the critics' action, root entry [*, n]: the executed one.

    Raises:
        ValueError: if the decoder does not join the actor's sample to the critics' input.

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
        ...         "synergy": torch.zeros(4, 2),
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

    decoder_network: TensorDictModule

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule,
        decoder: TensorDictModule,
        *,
        train_decoder: bool = True,
        **kwargs: Any,
    ) -> None:
        (sampled,), (decoded,) = decoder.in_keys, decoder.out_keys
        if sampled not in actor_network.out_keys or decoded not in qvalue_network.in_keys:
            raise ValueError(
                f"The decoder maps {sampled!r} to {decoded!r}, the actor writes "
                f"{list(actor_network.out_keys)} and the critic reads "
                f"{list(qvalue_network.in_keys)}; the decoder's input must be the actor's sample "
                "and its output the critic's action."
            )
        super().__init__(actor_network, qvalue_network, **kwargs)
        self.decoded_key: NestedKey = decoded
        self.train_decoder = train_decoder
        self.convert_to_functional(decoder, "decoder_network", create_target_params=False)

    def _make_vmap(self) -> None:
        super()._make_vmap()
        value = self._vmap_qnetworkN0

        def decode_then_value(data: TensorDictBase, params: TensorDictBase) -> TensorDictBase:
            # SACLoss puts a sample here only when it is fresh; replayed transitions come with the
            # critics' own keys alone, so their executed action is left as it is.
            if self.tensor_keys.action in data.keys(True):
                data = self._decode(data)
            return value(data, params)

        self._vmap_qnetworkN0 = decode_then_value

    def _decode(self, data: TensorDictBase) -> TensorDictBase:
        params = self.decoder_network_params
        with (params if self.train_decoder else params.detach()).to_module(
            self.decoder_network, preserve_module_state=False
        ):
            decoded = self.decoder_network(data.select(self.tensor_keys.action))
        return data.copy().set(self.decoded_key, decoded.get(self.decoded_key))
