"""Why the radio matters in learning: a formation is learned with a perfect radio and with a lossy one, and tried with both.

Evolution strategies (the package ``cma``) train a linear policy, shared by all vehicles, in 256 worlds side by side: one
generation is one episode of all candidates. Each training is repeated with other seeds; the figure shows the mean error of the
formation, with its 95 % interval over the trainings.

    python examples/learning/train.py             # some minutes on two cores
    python examples/learning/train.py --generations 4 --trainings 2
"""

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from pathlib import Path

import cma
import numpy as np
from matplotlib.figure import Figure
from scipy.stats import t as student

from vcmvsp.env import Formation, WorldsEnv, vector_env
from vcmvsp.policy import meta_of, save_network

LOSSY = {
    "loss": {"kind": "bernoulli", "probability": 0.5},
    "delay": {"kind": "fixed", "seconds": 0.4, "jitter_s": 0.1},
}
RADIOS = {"perfect": {"radio": {"preset": "ideal"}}, "lossy": {"radio": LOSSY}}
CANDIDATES, WORLDS = 32, 8  # of a generation; worlds of each candidate
TICKS, SETTLED = 100, 25  # of an episode; from when on the error counts
UNSEEN = 5_000_000  # seed of the first world of a trial: no training has it
TRIED = 256  # worlds of a trial


def environment(radio: str, worlds: int) -> WorldsEnv:
    """Three vehicles in the air around a point that only the first one sees."""
    task = Formation(kind="point", flies=True, max_speed=2.0)
    return vector_env(task, num_envs=worlds, set=RADIOS[radio], max_cycles=TICKS)


def scale_of(env: WorldsEnv) -> np.ndarray:
    """Factors (size,) that bring all inputs of the policy to the order of 1."""
    scale = np.full(env.layout.size, 0.2)
    others = np.ones((env.layout.vehicles - 1, env.layout.message_floats + 3))
    others[:, -2] = 0.01  # levels in dBm
    scale[env.layout.others] = others.ravel()
    return scale


def errors_of(env: WorldsEnv, weights: np.ndarray, seed: int) -> np.ndarray:
    """Mean error of each world in an episode, (w,) m, with linear policies (w, size + 1, a), one for each world."""
    scale, errors = scale_of(env), []
    observations, _ = env.reset(seed)
    for _ in range(TICKS):
        actions = np.tanh(np.matmul(observations * scale, weights[:, :-1]) + weights[:, -1:])
        observations, rewards, *_ = env.step(actions)
        errors.append(-rewards.mean(axis=1))
    return np.mean(errors[SETTLED:], axis=0)


def train(radio: str, seed: int, generations: int) -> np.ndarray:
    """Weights (size + 1, a) of a policy that was trained with a radio."""
    env = environment(radio, CANDIDATES * WORLDS)
    shape = env.layout.size + 1, env.single_action_space.shape[0]
    options = {"popsize": CANDIDATES, "seed": seed, "CMA_diagonal": True, "verbose": -9}
    search = cma.CMAEvolutionStrategy(np.zeros(shape[0] * shape[1]), 0.2, options)
    for generation in range(generations):
        candidates = np.array(search.ask())
        weights = np.repeat(candidates.reshape(-1, *shape), WORLDS, axis=0)
        errors_m = errors_of(env, weights, 10_000_000 * seed + env.num_envs * generation)
        search.tell(candidates, errors_m.reshape(CANDIDATES, WORLDS).mean(axis=1).tolist())
    return np.array(search.result.xfavorite).reshape(shape)


def trial(radio: str, seed: int, generations: int, out: Path) -> list[float]:
    """Train once; the mean error of the policy with each radio, m."""
    weights = train(radio, seed, generations)
    env = environment(radio, 1)
    save_network(out / f"{radio}-{seed}.npz", [(weights[:-1], weights[-1])], meta_of(env.task, env.layout), scale_of(env))
    every = np.repeat(weights[None], TRIED, axis=0)
    return [float(errors_of(environment(each, TRIED), every, UNSEEN).mean()) for each in RADIOS]


def saved(errors_m: np.ndarray) -> str:
    """What training with the lossy radio saves under it, with the 95 % interval; errors (trained, training, tried) m."""
    gain = errors_m[0, :, 1] - errors_m[1, :, 1]  # of the same seeds
    half = student.ppf(0.975, len(gain) - 1) * gain.std(ddof=1) / np.sqrt(len(gain))
    return f"with the lossy radio, training with it saves {gain.mean():.2f} +- {half:.2f} m of {errors_m[0, :, 1].mean():.2f} m"


def picture(errors_m: np.ndarray, out: Path) -> None:
    """Bars of mean errors with intervals, from errors (trained, training, tried)."""
    figure = Figure(figsize=(6.0, 3.4), layout="constrained")
    axes = figure.subplots()
    count = errors_m.shape[1]
    half = student.ppf(0.975, count - 1) * errors_m.std(axis=1, ddof=1) / np.sqrt(count)
    for number, radio in enumerate(RADIOS):
        places = np.arange(len(RADIOS)) + 0.4 * (number - 0.5)
        axes.bar(
            places, errors_m[number].mean(axis=0), 0.36, yerr=half[number], capsize=4, label=f"trained with a {radio} radio"
        )
    axes.set_xticks(range(len(RADIOS)), [f"{radio} radio" for radio in RADIOS])
    axes.set_ylabel("formation error [m]")
    axes.set_title(f"{count} trainings each, means and 95 % intervals; {saved(errors_m)}", fontsize=7.5)
    axes.legend(frameon=False)
    figure.savefig(out / "train.png", dpi=150)


def main() -> None:
    """Train, try, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", nargs="?", type=Path, default=Path("runs/learning"), help="folder of policies and figure")
    parser.add_argument("--generations", type=int, default=400)
    parser.add_argument("--trainings", type=int, default=5, help="with each radio, at least 2")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    jobs = list(product(RADIOS, range(1, options.trainings + 1)))
    with ProcessPoolExecutor() as pool:
        waiting = [pool.submit(trial, radio, seed, options.generations, options.out) for radio, seed in jobs]
        found = []
        for (radio, seed), each in zip(jobs, waiting, strict=True):
            found.append(each.result())
            tried = ", ".join(f"{name} {error:.3f} m" for name, error in zip(RADIOS, found[-1], strict=True))
            print(f"trained with a {radio} radio, seed {seed}: {tried}", flush=True)
    errors_m = np.array(found).reshape(len(RADIOS), options.trainings, len(RADIOS))
    (out := options.out / "errors_m.json").write_text(json.dumps(dict(zip(RADIOS, errors_m.tolist(), strict=True)), indent=1))
    picture(errors_m, options.out)
    print(saved(errors_m))
    print(f"figure: {options.out / 'train.png'}\nerrors: {out}")


if __name__ == "__main__":
    main()
