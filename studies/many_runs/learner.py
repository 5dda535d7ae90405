"""Soft actor-critic of many runs in one update: the equations of the package's losses, stacked.

Sizes: N runs, B transitions in a batch, C critics, O entries of an observation, E that an actor
emits, n muscles, K returns on the support of the categorical critics.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence

import torch
from torch import Tensor, nn
from torchrl.data import Bounded

from torchrl_etl.functional import (
    categorical_cross_entropy,
    categorical_mean,
    project_categorical,
    reconstruction_loss,
    tanh_sum,
    tanh_sum_log_slope,
)
from torchrl_etl.learners import entropy_target
from torchrl_etl.modules import RunningNorm, SynergyDecoder
from torchrl_etl.modules.synergy_decoder import INSIDE

from .initial import initial_weights
from .networks import BatchNormBody, Mlp, ResidualBody, Stack
from .settings import Settings, Shape

__all__ = ["Learner"]

SMALLEST_STD = 0.01


class Learner:
    """Networks, replay buffer and updates of N runs.

    On CUDA the four things it does (:meth:`act`, :meth:`try_out`, :meth:`store`, :meth:`update`)
    are CUDA graphs.

    Args:
        shape (Shape): of the group.
        settings (sequence of Settings), seeds (sequence of int): of each run.
        observations (sequence of int): entries that each run's task shows.
        actions (int): muscles, with bounds of [-1, 1].
        decoders (sequence of SynergyDecoder, optional): of each run, alike in size; ``None``: the
            actor emits muscles.
        frames (int): to make room for.
        device (torch.device): of all tensors.
    """

    def __init__(
        self,
        shape: Shape,
        settings: Sequence[Settings],
        seeds: Sequence[int],
        observations: Sequence[int],
        actions: int,
        decoders: Sequence[SynergyDecoder] | None,
        frames: int,
        device: torch.device,
    ) -> None:
        self.shape, self.device = shape, device
        self.count, self.width = len(seeds), max(observations)
        self.emitted = decoders[0].synergy_dim if decoders else actions
        actors, critics = [], []
        for seed, own in zip(seeds, observations, strict=True):
            actor, several = initial_weights(shape, seed, own, self.emitted, actions, self.width)
            actors.append(actor)
            critics += several
        self.actor = self._stack(actors)
        self.critic = self._stack(critics)
        self.target = self.critic.weights.detach().clone()
        self.target_body = self._body(critics)  # with statistics of its own
        self.average = self.actor.weights.detach().clone()
        self.decoder = None
        if decoders:
            layers = [list(decoder.module.decoder.mlp.parameters()) for decoder in decoders]
            self.decoder, self.residual = Stack(Mlp(), layers, device), decoders[0].residual
            self.center, self.box = (
                torch.stack([getattr(d.module, name) for d in decoders]).to(device).unsqueeze(1)
                for name in ("center", "scale")
            )

        def each(value: Callable[[Settings], float]) -> Tensor:  # [N, 1]
            return torch.tensor([[value(one)] for one in settings], device=device)

        spec = Bounded(-1.0, 1.0, shape=(self.emitted,))
        self.entropy = each(lambda s: entropy_target(spec, s.action_std))
        self.log_alpha = each(lambda s: math.log(s.alpha_init)).requires_grad_()
        self.gamma, self.steps = each(lambda s: s.gamma), each(lambda s: s.n_steps)
        self.uniform = each(lambda s: s.uniform_frames)
        chances = torch.arange(1.0, shape.longest + 1, device=device) ** -each(lambda s: s.exponent)
        self.chances = chances.cumsum(1) / chances.sum(1, keepdim=True)
        self.support = torch.linspace(-shape.bound, shape.bound, shape.bins, device=device)

        def zeros(*size: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(self.count, *size, device=device, dtype=dtype)

        sizes = {"observation": self.width, "following": self.width, "emitted": self.emitted}
        sizes |= {"action": actions, "reward": 1, "terminated": 1, "done": 1}
        self.buffer = {name: zeros(frames, size) for name, size in sizes.items()}
        self.size = torch.zeros((), dtype=torch.long, device=device)
        self.norm = RunningNorm(self.count * self.width).to(device)
        self.updates = torch.zeros((), device=device)
        # What simulators tell: reward, terminated, done, the scale of rewards, and what was seen
        # after the step and is seen now.
        self.told = zeros(4 + 2 * self.width)
        self.told[:, 2:4] = 1.0
        self.seen, self.now, self.muscles = zeros(self.width), zeros(self.emitted), zeros(actions)
        self.noise, self.left = zeros(self.emitted), zeros(1, dtype=torch.long)
        self.logged = zeros(3)
        groups = [([self.actor.weights, self.critic.weights, self.log_alpha], shape.lr)]
        if self.decoder is not None and shape.decoder_lr:
            groups.append(([self.decoder.weights], shape.decoder_lr))
        graphed = device.type == "cuda"
        self.optimizer = torch.optim.Adam(
            [{"params": of, "lr": torch.tensor(lr, device=device)} for of, lr in groups],
            fused=True,
            capturable=graphed,
        )
        self.trained = [parameter for of, _ in groups for parameter in of]
        self.constrain()
        if graphed:
            self._record()

    # What a run does --------------------------------------------------------------------------

    @torch.no_grad()
    def act(self) -> None:
        """Muscles [N, n] for what is seen now; noise is held for some steps."""
        self.seen.copy_(self.told[:, -self.width :])
        self.norm.see(self.seen.view(1, -1))
        loc, scale = self._policy(self._normal(self.seen.unsqueeze(1)), self.actor.weights)
        fresh = (self.told[:, 2:3] > 0) | (self.left == 0)
        lengths = 1 + torch.searchsorted(self.chances, torch.rand_like(self.chances[:, :1]))
        lengths = lengths.clamp(max=self.shape.longest)
        self.left.copy_(torch.where(fresh, lengths, self.left) - 1)
        self.noise.copy_(torch.where(fresh, torch.randn_like(self.noise), self.noise))
        emitted = (loc.squeeze(1) + scale.squeeze(1) * self.noise).tanh()
        uniform = 2 * torch.rand_like(emitted) - 1
        self.now.copy_(torch.where(self.size < self.uniform, uniform, emitted))
        self.muscles.copy_(self._decode(self.now.unsqueeze(1)).squeeze(1))

    @torch.no_grad()
    def try_out(self) -> None:
        """Muscles that the averaged actor chooses, without noise."""
        loc, _ = self._policy(self._normal(self.told[:, None, -self.width :]), self.average)
        self.muscles.copy_(self._decode(loc.tanh()).squeeze(1))

    @torch.no_grad()
    def store(self) -> None:
        """Keep the transition that began with the last :meth:`act`."""
        reward, terminated, done = self.told[:, :3].split(1, 1)
        new = {"observation": self.seen, "following": self.told[:, 4 : 4 + self.width]}
        new |= {"emitted": self.now, "action": self.muscles}
        new |= {"reward": reward, "terminated": terminated, "done": done}
        for name, value in new.items():
            self.buffer[name].index_copy_(1, self.size.view(1), value.unsqueeze(1))
        self.size += 1

    @torch.no_grad()
    def give(self, rows: Mapping[str, Tensor]) -> None:
        """Begin with transitions [N, R, *] of another policy."""
        count = rows["reward"].shape[1]
        for name, value in rows.items():
            self.buffer[name][:, :count] = value.to(self.device)
        self.size += count
        self.norm.see(self.buffer["observation"][:, :count].transpose(0, 1).flatten(1))

    def update(self) -> None:
        losses, logged = self.losses(self.sample())
        gradients = torch.autograd.grad(losses.sum(), self.trained)
        for parameter, gradient in zip(self.trained, gradients, strict=True):
            parameter.grad = gradient
        self.optimizer.step()
        self.constrain()
        with torch.no_grad():
            self.target.lerp_(self.critic.weights, self.shape.tau)
            kept = ((1 + self.updates) / (10 + self.updates)).clamp(max=self.shape.share)
            taken = torch.where(self.updates > 0, 1 - kept, torch.ones_like(kept))
            self.average.lerp_(self.actor.weights, taken)
            self.updates += 1
            self.logged.copy_(logged)

    # The equations ----------------------------------------------------------------------------

    def losses(self, batch: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Losses [N]; and entropy, temperature and mean value [N, 3]."""
        rows, joint = self.shape.batch_size, self.shape.body == "batch_norm"
        alpha = self.log_alpha.detach().exp()
        # Statistics of a batch are those of both ends of its transitions.
        if joint:
            both = torch.cat([batch["observation"], batch["following"]], 1)
            loc, scale = self._policy(both, self.actor.weights, training=True)
            (loc, next_loc), (scale, next_scale) = loc.split(rows, 1), scale.split(rows, 1)
        else:
            loc, scale = self._policy(batch["observation"], self.actor.weights)
            with torch.no_grad():
                next_loc, next_scale = self._policy(batch["following"], self.actor.weights)
        action, log_prob = self._chosen(loc, scale)
        with torch.no_grad():
            next_action, next_log_prob = self._chosen(next_loc, next_scale)
            start = torch.cat([batch["observation"], batch["action"]], -1)
            end = torch.cat([batch["following"], next_action], -1)
            outputs = self._logits(self.target_body, self.target, end, beside=start)
            smaller = categorical_mean(outputs, self.support).argmin(1)[:, None, :, None]
            probabilities = outputs.gather(1, smaller.expand_as(outputs[:, :1])).squeeze(1)
            shifted = self.support - (alpha * next_log_prob).unsqueeze(-1)
            atoms = batch["reward"].unsqueeze(-1) + batch["discount"].unsqueeze(-1) * shifted
            target = project_categorical(probabilities.softmax(-1), atoms, self.support)
        outputs = self._logits(self.critic.body, self.critic.weights, start, beside=end)
        loss_critic = categorical_cross_entropy(outputs, target.unsqueeze(1)).sum(1).mean(-1)

        chosen = torch.cat([batch["observation"], action], -1)
        outputs = self._logits(self.critic.body, self.critic.weights.detach(), chosen)
        values = categorical_mean(outputs, self.support).amin(1)
        loss_actor = (alpha * log_prob - values).mean(-1)
        loss_alpha = -(self.log_alpha * (log_prob.detach() + self.entropy)).mean(-1)
        losses = loss_critic + loss_actor + loss_alpha
        if self.decoder is not None and self.shape.decoder_lr:
            replayed = reconstruction_loss(self._decode(batch["emitted"]), batch["action"])
            losses = losses + self.shape.anchor * replayed.mean(-1)
        logged = (-log_prob.mean(-1), alpha.squeeze(1), values.mean(-1))
        return losses, torch.stack([x.detach() for x in logged], 1)

    def _policy(
        self, observation: Tensor, weights: Tensor, *, training: bool = False
    ) -> tuple[Tensor, Tensor]:
        loc, raw = self.actor(observation, weights, training=training).chunk(2, -1)
        one = math.log(math.expm1(1.0 - SMALLEST_STD))  # where a standard deviation of one is
        return loc, nn.functional.softplus(raw + one) + SMALLEST_STD

    def _logits(
        self,
        body: Callable[[Tensor, Iterator[Tensor], bool], Tensor],
        weights: Tensor,
        inputs: Tensor,
        *,
        beside: Tensor | None = None,
    ) -> Tensor:
        """Logits [N, C, B, K]; batch statistics are taken together with those of ``beside``.

        Without it they are the running ones.
        """
        training = self.shape.body == "batch_norm" and beside is not None
        both = torch.cat([inputs, beside], 1) if training else inputs
        each = both.repeat_interleave(self.shape.num_critics, 0)
        logits = body(each, iter(self.critic.split(weights)), training)
        return logits[:, : inputs.shape[1]].unflatten(0, (self.count, self.shape.num_critics))

    def _chosen(self, loc: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        """Fresh muscles [N, B, n] and the log-probability [N, B] of what chose them."""
        emitted, log_prob = _sampled(loc, scale)
        if self.decoder is None or not self.residual:
            return self._decode(emitted), log_prob
        summands = self._summands(emitted)
        return tanh_sum(*summands), log_prob - tanh_sum_log_slope(*summands).sum(-1)

    def _decode(self, emitted: Tensor) -> Tensor:
        if self.decoder is None:
            return emitted
        if not self.residual:
            return self._base(emitted)
        return tanh_sum(*self._summands(emitted))

    def _summands(self, emitted: Tensor) -> tuple[Tensor, Tensor]:
        latent = self.center.shape[-1]
        return INSIDE * self._base(emitted[..., :latent]), self.residual * emitted[..., latent:]

    def _base(self, coefficients: Tensor) -> Tensor:
        return self.decoder(self.center + self.box * coefficients).tanh()

    @torch.no_grad()
    def sample(self) -> dict[str, Tensor]:
        """A batch of each run, rewards scaled and summed over ``n_steps``."""

        def pick(name: str, index: Tensor) -> Tensor:
            rows = index.unsqueeze(-1).expand(-1, -1, self.buffer[name].shape[-1])
            return self.buffer[name].gather(1, rows)

        def at(name: str, index: Tensor) -> Tensor:
            return pick(name, index).squeeze(-1)

        drawn = torch.rand(self.count, self.shape.batch_size, device=self.device)
        first = torch.minimum((drawn * self.size).long(), self.size - 1)
        last, discount, reward = first, self.gamma.expand_as(drawn), at("reward", first)
        for step in range(1, self.shape.most_steps):
            further = (at("done", last) == 0) & (self.steps > step) & (last + 1 < self.size)
            last = torch.where(further, last + 1, last)
            reward = reward + further * discount * at("reward", last)
            discount = torch.where(further, discount * self.gamma, discount)
        entries = {name: pick(name, first) for name in ("observation", "emitted", "action")}
        entries["following"] = self._normal(pick("following", last))
        entries["observation"] = self._normal(entries["observation"])
        entries["reward"] = reward / self.told[:, 3:4]
        return entries | {"discount": discount * (1 - at("terminated", last))}

    def _normal(self, observation: Tensor) -> Tensor:
        """Observations [N, *, O] in deviations of those seen by their run, if the shape says so."""
        if not self.shape.normalize_observations:
            return observation
        rows = observation.transpose(0, 1)
        return self.norm(rows.flatten(1)).view(rows.shape).transpose(0, 1)

    @torch.no_grad()
    def constrain(self) -> None:
        if self.shape.unit_rows:
            self.actor.normalize_rows()
            self.critic.normalize_rows()

    # Parts ------------------------------------------------------------------------------------

    def _body(self, networks: Sequence[Sequence[Tensor]]) -> ResidualBody | BatchNormBody:
        if self.shape.body == "residual":
            return ResidualBody(self.shape.blocks)
        return BatchNormBody.like(networks, self.shape.blocks, self.device)

    def _stack(self, networks: Sequence[Sequence[Tensor]]) -> Stack:
        return Stack(self._body(networks), networks, self.device)

    def _record(self) -> None:
        """Make CUDA graphs of what a run does; whatever that changes is put back."""
        changed = [self.actor.weights, self.critic.weights, self.log_alpha, self.target]
        changed += [self.average, self.size, self.updates, self.told, self.noise, self.left]
        changed += self.norm.buffers()
        for body in (self.actor.body, self.critic.body, self.target_body):
            changed += getattr(body, "running", [])
        if self.decoder is not None:
            changed.append(self.decoder.weights)
        before = [tensor.detach().clone() for tensor in changed]
        self.size += 1
        side = torch.cuda.Stream()
        for function in (self.act, self.try_out, self.store, self.update):
            side.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(side):
                for _ in range(3):
                    function()
            torch.cuda.current_stream().wait_stream(side)
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph):
                function()
            setattr(self, function.__name__, graph.replay)
        with torch.no_grad():
            for tensor, value in zip(changed, before, strict=True):
                tensor.copy_(value)
            for state in self.optimizer.state.values():
                for value in state.values():
                    value.zero_()


def _sampled(loc: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
    """A tanh-Gaussian sample [N, B, E] and its log-probability [N, B]."""
    noise = torch.randn_like(loc)
    raw = loc + scale * noise
    normal = -noise.square() / 2 - scale.log() - math.log(2 * math.pi) / 2
    slope = 2 * (math.log(2) - raw - nn.functional.softplus(-2 * raw))
    return raw.tanh(), (normal - slope).sum(-1)
