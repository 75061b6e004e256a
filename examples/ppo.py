# SPDX-License-Identifier: Apache-2.0
"""PPO (Schulman et al. 2017) on worlds stepped side by side: `python examples/ppo.py cartpole`, or `go1`, `g1`.

It needs gymnasium and torch: pip install "warpmpc[gymnasium]" torch; go1 and g1 need pip install --no-deps mjlab, too.
"""

import argparse
import time
from itertools import pairwise

import numpy as np

try:
    import torch
    from gymnasium.wrappers.vector import RecordEpisodeStatistics
except ModuleNotFoundError as error:
    raise SystemExit(f'error: ppo.py needs {error.name}: pip install "warpmpc[gymnasium]" torch') from None
from tasks import cartpole, walking


def network(widths: list[int]) -> torch.nn.Sequential:
    """A multilayer perceptron."""
    layers = [(torch.nn.Linear(a, b), torch.nn.ELU()) for a, b in pairwise(widths)]
    return torch.nn.Sequential(*[part for layer in layers for part in layer][:-1])


class Agent(torch.nn.Module):
    """A normal distribution of actions about a network's mean, and a value, of normalized observations."""

    def __init__(self, size: int, actions: int):
        super().__init__()
        self.norm = torch.nn.BatchNorm1d(size, affine=False, momentum=None).eval()
        self.mean, self.value = (network([size, 128, 64, 32, outputs]) for outputs in (actions, 1))
        with torch.no_grad():
            self.mean[-1].weight *= 0.01
        self.log_std = torch.nn.Parameter(torch.full((actions,), -1.0))

    def forward(self, observation: torch.Tensor) -> tuple[torch.distributions.Normal, torch.Tensor]:
        """Distribution of actions ``[B, nu]`` and values ``[B]`` of observations ``[B, n]``."""
        x = self.norm(observation).clamp(-10.0, 10.0)
        return torch.distributions.Normal(self.mean(x), self.log_std.exp()), self.value(x)[:, 0]


@torch.no_grad()
def collect(env, agent: Agent, first: np.ndarray, steps: int) -> tuple[list[torch.Tensor], np.ndarray]:
    """Observations, actions, log-probabilities, advantages (λ = 0.95, γ = 0.99) and values to learn of some steps."""
    rows, observation = [], first
    for _ in range(steps):
        x = torch.from_numpy(observation)
        policy, value = agent(x)
        action = policy.sample()
        observation, reward, terminated, truncated, info = env.step(action.numpy())
        over = terminated | truncated
        if (cut := truncated & ~terminated).any():  # what would have come is part of the return
            reward[cut] += 0.99 * agent(torch.from_numpy(np.stack(info["final_obs"][cut])))[1].numpy()
        numbers = torch.from_numpy(np.stack([reward, 1.0 - over]).astype(np.float32))
        rows.append((x, action, policy.log_prob(action).sum(1), value, *numbers))
    x, action, log_prob, value, reward, alive = (torch.stack(column) for column in zip(*rows, strict=True))
    after, advantage, total = agent(torch.from_numpy(observation))[1], torch.zeros_like(value), 0.0
    for t in reversed(range(steps)):
        total = reward[t] + 0.99 * alive[t] * after - value[t] + 0.99 * 0.95 * alive[t] * total
        advantage[t], after = total, value[t]
    return [part.flatten(0, 1) for part in (x, action, log_prob, advantage, advantage + value)], observation


def learn(
    agent: Agent, optimizer: torch.optim.Adam, batch: list[torch.Tensor], rounds: int = 5, parts: int = 4
) -> None:
    """Take gradient steps of the clipped objective; the step size keeps the policy's divergence about 0.01."""
    for order in (torch.randperm(len(batch[0])) for _ in range(rounds)):
        for rows in order.chunk(parts):
            x, action, old, advantage, target = (part[rows] for part in batch)
            policy, value = agent(x)
            change = policy.log_prob(action).sum(1) - old
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            gain = torch.min(change.exp() * advantage, change.exp().clamp(0.8, 1.2) * advantage).mean()
            loss = (value - target).square().mean() - gain - 0.003 * policy.entropy().sum(1).mean()
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(agent.parameters(), 1.0)
            optimizer.step()
            divergence = (change.exp() - 1.0 - change).mean().item()
            factor = 1 / 1.5 if divergence > 0.02 else 1.5 if divergence < 0.005 else 1.0
            optimizer.param_groups[0]["lr"] = min(max(optimizer.param_groups[0]["lr"] * factor, 1e-5), 3e-3)
    agent.norm.train()(batch[0])
    agent.norm.eval()


def main() -> None:
    """Train, and print how far it is."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task", choices=["cartpole", "go1", "g1"])
    parser.add_argument("--minutes", type=float, default=1.0, help="how long it trains")
    parser.add_argument("--worlds", type=int, default=1024)
    parser.add_argument("--threads", type=int, default=0, help="0: one for each core")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.manual_seed(args.seed)
    torch.set_num_threads(args.threads or torch.get_num_threads())
    make = cartpole if args.task == "cartpole" else walking
    env = RecordEpisodeStatistics(make(args.task, args.worlds, args.threads), args.worlds)
    agent = Agent(env.single_observation_space.shape[0], env.single_action_space.shape[0])
    optimizer = torch.optim.Adam(agent.parameters(), 1e-3, eps=1e-5)
    observation, _ = env.reset(seed=args.seed)
    begin, taken, simulated, told = time.perf_counter(), 0, 0.0, 0.0
    while (spent := time.perf_counter() - begin) < 60.0 * args.minutes:
        batch, observation = collect(env, agent, observation, 24)
        simulated += time.perf_counter() - begin - spent
        learn(agent, optimizer, batch)
        taken += len(batch[0])
        if (spent := time.perf_counter() - begin) > told:
            told = spent + 3.0 * args.minutes
            terms = ", ".join(f"{name} {values.mean():.2f}" for name, values in env.unwrapped.reward_terms().items())
            mean, length = (np.mean(queue) if queue else np.nan for queue in (env.return_queue, env.length_queue))
            print(f"{spent:6.1f} s {taken:10,} steps ({taken / spent:,.0f}/s, {simulated / spent:.0%} simulating): "
                  f"return {mean:.1f}, length {length:.0f}; a step: {terms}", flush=True)  # fmt: skip
    observation, _ = env.reset(seed=args.seed + 1)
    up = np.ones(args.worlds, dtype=bool)
    for _ in range(499):  # the mean of the policy, in their own episodes
        observation, _, terminated, *_ = env.step(agent(torch.from_numpy(observation))[0].mean.detach().numpy())
        up &= ~terminated
    ends = np.array(env.unwrapped.simulator.qpos)[:, 0]
    print(f"{up.mean():.1%} of {args.worlds} worlds stay up for 499 steps; the median of x is {np.median(ends):.2f} m")


if __name__ == "__main__":
    main()
