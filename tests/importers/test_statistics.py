import io
import json
import pickle
import re
import struct
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import otr
from otr.importers import read_policy
from otr.importers.input_statistics import ObservationStatistics
from tests.importers.test_importers import Bomb, FourActions, WideBox, build

torch.set_num_threads(1)

MEAN, VARIANCE = np.array([1.0, -20.0, 0.003]), np.array([4.0, 0.25, 1e-6])


class SeveralInputs(FourActions):
    observation_space = gym.spaces.Dict({"near": gym.spaces.Box(-1, 1, (2,)), "far": gym.spaces.Box(-1, 1, (3,))})

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        return self.observation_space.sample(), {}


def normalised(env: object, **options: object) -> VecNormalize:
    wrapped = VecNormalize(DummyVecEnv([lambda: env]), **options)
    wrapped.reset()
    if not isinstance(wrapped.observation_space, gym.spaces.Dict) and wrapped.norm_obs:
        wrapped.obs_rms.mean, wrapped.obs_rms.var = MEAN.copy(), VARIANCE.copy()
    return wrapped


@pytest.mark.parametrize("algorithm", [PPO, SAC])
def test_the_network_takes_raw_states(tmp_path: Path, algorithm: type) -> None:
    env = normalised(WideBox(), clip_obs=3.0, epsilon=1e-4)
    critic = {"vf": [8]} if algorithm is PPO else {"qf": [8]}
    model = build(algorithm, env, critic, [6, 5])
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.normal_()
    model.save(tmp_path / "model")
    env.save(str(tmp_path / "statistics.pkl"))
    reach = 3 * np.sqrt(VARIANCE + 1e-4)
    X = MEAN + np.random.default_rng(0).uniform(-2, 2, (500, 3)) * reach
    inside = (np.abs(X - MEAN) <= reach).all(axis=1)
    assert 20 < inside.sum() < 200
    expected = model.predict(env.normalize_obs(X), deterministic=True)[0]
    for statistics in (
        tmp_path / "statistics.pkl",
        str(tmp_path / "statistics.pkl"),
        env,
        ObservationStatistics(MEAN, VARIANCE, 1e-4, 3.0),
    ):
        for source in (model, tmp_path / "model"):
            network = otr.from_sb3(source, normalise=statistics)
            np.testing.assert_allclose(network.predict(X[inside]), expected[inside], atol=2e-5)
            assert np.abs(network.predict(X) - expected).max() > 0.01, "outside, VecNormalize clips and this does not"
            assert network.domain is not None
            np.testing.assert_allclose([network.domain.low, network.domain.high], [MEAN - reach, MEAN + reach])
            np.testing.assert_array_equal(network.domain.contains(X), inside)


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_every_protocol_is_read(tmp_path: Path, protocol: int) -> None:
    env = normalised(FourActions())
    env.observation_space.sample(), env.action_space.sample()  # both hold a generator then
    with (tmp_path / "statistics.pkl").open("wb") as file:
        pickle.dump(env, file, protocol=protocol)
    model = build(PPO, env, {"vf": [8]}, [4])
    network = otr.from_sb3(model, normalise=tmp_path / "statistics.pkl")
    np.testing.assert_array_equal(network.weights[0], otr.from_sb3(model, normalise=env).weights[0])
    raw = otr.from_sb3(model, normalise=None)
    np.testing.assert_allclose(network.weights[0], raw.weights[0] / np.sqrt(VARIANCE + 1e-8))


def test_statistics_of_a_live_model_are_folded_in() -> None:
    env = normalised(WideBox())
    model = build(PPO, env, {"vf": [8]}, [6])
    X = MEAN + np.random.default_rng(0).uniform(-5, 5, (100, 3)) * np.sqrt(VARIANCE)
    expected = model.predict(env.normalize_obs(X), deterministic=True)[0]
    network = otr.from_sb3(model)
    np.testing.assert_allclose(network.predict(X), expected, atol=1e-5)
    assert network.domain is not None and network.domain.contains(X).all()
    raw = otr.from_sb3(model, normalise=None)
    assert raw.domain is None and np.abs(raw.predict(X) - expected).max() > 0.01
    np.testing.assert_allclose(raw.predict(env.normalize_obs(X)), expected, atol=1e-5)
    env.norm_obs = np.bool_(False)
    np.testing.assert_array_equal(otr.from_sb3(model).weights[0], raw.weights[0])


@pytest.mark.parametrize("place", ["model/vecnormalize.pkl", "vecnormalize.pkl"])
def test_statistics_beside_a_zip_are_found(tmp_path: Path, place: str) -> None:
    env = normalised(WideBox())
    build(PPO, env, {"vf": [8]}, [6]).save(tmp_path / "model.zip")
    (tmp_path / place).parent.mkdir(exist_ok=True)
    env.save(str(tmp_path / place))
    raw = otr.from_sb3(tmp_path / "model", normalise=None)
    for read in (otr.from_sb3, read_policy):
        with pytest.warns(UserWarning, match=rf"is read with the statistics of .*{place}, .* normalise=None says"):
            network = read(tmp_path / "model.zip")
        np.testing.assert_allclose(network.weights[0], raw.weights[0] / np.sqrt(VARIANCE + 1e-8))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            np.testing.assert_array_equal(
                read(tmp_path / "model.zip", normalise=None).weights[0], raw.weights[0], "none wins"
            )
            np.testing.assert_array_equal(
                read(tmp_path / "model.zip", normalise=tmp_path / place).weights[0], network.weights[0]
            )
    two = DummyVecEnv([lambda: gym.make("MountainCarContinuous-v0")])
    VecNormalize(two).save(str(tmp_path / place))
    with (
        pytest.warns(UserWarning),
        pytest.raises(otr.InvalidNetworkError, match=rf"{place} are of 2 means .* or normalise=None"),
    ):
        otr.from_sb3(tmp_path / "model.zip")


@pytest.mark.parametrize("algorithm", [PPO, SAC])
def test_a_zip_shows_that_its_statistics_are_missing(tmp_path: Path, algorithm: type) -> None:
    critic, options = ({"vf": [8]}, {"n_steps": 32, "batch_size": 32}) if algorithm is PPO else ({"qf": [8]}, {})
    for kind, last in ((VecNormalize, [[0.3, 1.5, -2.0]]), (lambda env: env, [[0.3, 1.0, -2.0]])):
        env = kind(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
        model = build(algorithm, env, critic, [3], **options).learn(32)
        model._last_obs = np.float32(last)  # [-1, 1], [-1, 1], [-8, 8] are the observations
        model.save(tmp_path / "model")
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            otr.from_sb3(tmp_path / "model")
            otr.from_sb3(tmp_path / "model", normalise=None)
        if kind is not VecNormalize:
            assert not told
            continue
        (warned,) = told
        sign = "was trained under VecNormalize" if algorithm is PPO else "has seen 1.5, outside the range of its obs"
        assert re.search(rf"{sign}.* no vecnormalize.pkl is next to it", str(warned.message))


def test_what_is_not_normalised_or_not_clipped(tmp_path: Path) -> None:
    raw = normalised(FourActions(), norm_obs=False)
    model = build(PPO, raw, {"vf": [8]}, [4])
    raw.save(str(tmp_path / "raw.pkl"))
    for no in (False, np.bool_(False)):
        raw.norm_obs = no
        raw.save(str(tmp_path / "raw.pkl"))
        for statistics in (raw, tmp_path / "raw.pkl"):
            network = otr.from_sb3(model, normalise=statistics)
            assert network.domain is None
            np.testing.assert_array_equal(network.weights[0], otr.from_sb3(model).weights[0])
    yes = normalised(FourActions())
    yes.norm_obs = np.bool_(True)
    yes.save(str(tmp_path / "yes.pkl"))
    assert otr.from_sb3(model, normalise=tmp_path / "yes.pkl").domain is not None
    free = otr.from_sb3(model, normalise=ObservationStatistics(MEAN, VARIANCE, clip=np.inf))
    assert free.domain is None
    np.testing.assert_allclose(free.weights[0], otr.from_sb3(model).weights[0] / np.sqrt(VARIANCE + 1e-8))


@pytest.mark.parametrize("kind", ["dict", "json", "npz", "gymnasium"])
@pytest.mark.parametrize("units", [torch.nn.ReLU, torch.nn.SiLU])
def test_statistics_beside_any_policy(tmp_path: Path, kind: str, units: type) -> None:
    """A ReLU network has them in its first layer, inside its domain; a black box sees the states as training did."""
    torch.manual_seed(0)
    module = torch.nn.Sequential(torch.nn.Linear(3, 5), units(), torch.nn.Linear(5, 2)).double()
    given = {"mean": MEAN, "var": VARIANCE, "epsilon": 1e-3, "clip": 0.8}
    if kind == "gymnasium":
        env = gym.wrappers.NormalizeObservation(gym.make("Pendulum-v1"), epsilon=1e-3)
        env.obs_rms.mean, env.obs_rms.var = MEAN, VARIANCE
        statistics, given = env, {**given, "clip": np.inf}
    elif kind == "json":  # rsl_rl's (x - mean) / (std + epsilon)
        given |= {"std": np.sqrt(VARIANCE)}
        statistics = tmp_path / "statistics.json"
        statistics.write_text(json.dumps({k: np.array(v).tolist() for k, v in given.items() if k != "var"}))
    else:
        statistics = given if kind == "dict" else tmp_path / "statistics.npz"
        np.savez(tmp_path / "statistics.npz", **given)
    policy = read_policy(module, normalise=statistics)
    X = MEAN + np.sqrt(VARIANCE) * np.random.default_rng(0).normal(size=(200, 3))
    scale = np.sqrt(VARIANCE) + 1e-3 if kind == "json" else np.sqrt(VARIANCE + 1e-3)
    Z = (X - MEAN) / scale
    if units is torch.nn.ReLU:
        inside = np.abs(Z).max(axis=1) < given["clip"]
        assert (policy.domain is None) is (kind == "gymnasium") and inside.any()
        X, Z = X[inside], Z[inside]
    expected = module(torch.tensor(np.clip(Z, -given["clip"], given["clip"]))).detach().numpy()
    np.testing.assert_allclose(policy.predict(X), expected, rtol=1e-12, atol=1e-12)


def test_files_of_numbers_that_are_no_statistics(tmp_path: Path) -> None:
    assert "is no JSON" in refusal(tmp_path / "a.json", b"{")
    assert "has nothing, expected mean, epsilon, and var" in refusal(
        tmp_path / "a.json", b"[]", otr.InvalidNetworkError
    )
    assert "a.npz" in refusal(tmp_path / "a.npz", b"PK")
    np.savez(tmp_path / "b.npz", mean=np.array([Bomb(tmp_path / "ran")] * 3), var=VARIANCE, epsilon=1.0)
    assert "holds no arrays of numbers" in refusal(tmp_path / "c.npz", (tmp_path / "b.npz").read_bytes())
    assert not (tmp_path / "ran").exists()


def test_statistics_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    model = build(PPO, FourActions(), {"vf": [8]}, [4])
    several = normalised(SeveralInputs())
    several.save(str(tmp_path / "several.pkl"))
    refused = [
        (ObservationStatistics(MEAN[:2], VARIANCE[:2]), "2 means and 2 variances, the network has 3 inputs"),
        (ObservationStatistics(MEAN, -VARIANCE), r"smallest variance \+ epsilon is -4"),
        (ObservationStatistics(MEAN, VARIANCE, clip=0.0), "the clip is 0"),
        (ObservationStatistics(MEAN, VARIANCE, clip=1e200), r"the clip is 1e\+200, which gives no box"),
        (ObservationStatistics(MEAN * np.nan, VARIANCE), "finite means"),
        (several, r"the observations \['far', 'near'\]"),
        (tmp_path / "several.pkl", r"the observations \['far', 'near'\]"),
        (MEAN, "normalise is a ndarray, expected the path"),
        ({"mean": MEAN, "var": VARIANCE}, "normalise has 'mean', 'var', expected mean, epsilon, and var, of"),
        ({"mean": MEAN, "var": VARIANCE, "std": VARIANCE, "epsilon": 1}, "or std, of"),
        ({"mean": MEAN, "var": ["x"] * 3, "epsilon": 1}, "all of them real numbers"),
    ]
    for statistics, message in refused:
        with pytest.raises(otr.InvalidNetworkError, match=message):
            otr.from_sb3(model, normalise=statistics)


def refusal(path: Path, content: bytes, error: type = otr.ArtefactError) -> str:
    path.write_bytes(content)
    with pytest.raises(error) as caught:
        otr.from_sb3(build(PPO, FourActions(), {"vf": [8]}, [4]), normalise=path)
    return str(caught.value)


def test_code_in_a_file_of_statistics_is_not_run(tmp_path: Path) -> None:
    sentinel, path = tmp_path / "sentinel", tmp_path / "statistics.pkl"
    pickle.loads(pickle.dumps(Bomb(sentinel)))
    assert sentinel.exists(), "the bomb works"
    sentinel.unlink()

    env = normalised(FourActions())
    model = build(PPO, env, {"vf": [8]}, [4])
    for place in (env, env.obs_rms):  # beside what is read: it changes nothing, and is not run
        place.bomb = Bomb(sentinel)
    env.save(str(path))
    network = otr.from_sb3(model, normalise=path)
    np.testing.assert_array_equal(network.weights[0], otr.from_sb3(model, normalise=env).weights[0])
    for name in ("mean", "var"):
        env = normalised(FourActions())
        setattr(env.obs_rms, name, Bomb(sentinel))
        assert "holds no statistics of observations" in refusal(path, pickle.dumps(env))
    bomb = pickle.dumps(Bomb(sentinel))
    module = Path.touch.__module__  # pathlib, and pathlib._local in Python 3.13
    assert f"holds a {module}.Path.touch, expected a stable_baselines3" in refusal(path, bomb)
    assert "is no pickle" in refusal(
        path, b"\x80\x02cbuiltins\nexec\nX\x01\x00\x00\x00a\x85R\x85R."
    )  # calls its answer
    assert not sentinel.exists()


def test_files_that_are_no_statistics(tmp_path: Path) -> None:
    whole = io.BytesIO()
    pickle.dump(normalised(FourActions()), whole)
    path = tmp_path / "statistics.pkl"
    for share in (0.0, 0.3, 0.9):
        assert "is no pickle" in refusal(path, whole.getvalue()[: int(share * len(whole.getvalue()))])
    assert "holds a dict, expected" in refusal(path, pickle.dumps({"obs_rms": 3}))
    assert "LONG_BINPUT 2147483647" in refusal(path, b"\x80\x02Nr" + struct.pack("<I", 2**31 - 1) + b".")
    assert "EXT1 1" in refusal(path, b"\x80\x02\x82\x01.")
    assert "the limit is 16,777,216" in refusal(path, bytes(2**24 + 1))
    for place in (tmp_path / "none.pkl", tmp_path):
        with pytest.raises(otr.ArtefactError, match="cannot be read"):
            otr.from_sb3(build(PPO, FourActions(), {"vf": [8]}, [4]), normalise=place)


@pytest.mark.parametrize(
    ("name", "wrong", "error"),
    [
        ("mean", np.array([1.0, 2.0, "x"], dtype=object), otr.ArtefactError),
        ("mean", np.ones(3, dtype=complex), otr.ArtefactError),
        ("norm_obs", np.array([True]), otr.ArtefactError),
        ("norm_obs", np.float64(0.0), otr.ArtefactError),
        ("var", "text", otr.InvalidNetworkError),
        ("var", [1.0, "x", 2.0], otr.InvalidNetworkError),
    ],
)
def test_numbers_of_other_kinds_are_refused(tmp_path: Path, name: str, wrong: object, error: type) -> None:
    env = normalised(FourActions())
    setattr(env if name == "norm_obs" else env.obs_rms, name, wrong)
    told = refusal(tmp_path / "statistics.pkl", pickle.dumps(env), error)
    assert ("expected real numbers" if name == "var" else "holds no statistics of observations") in told
    if name == "var":
        with pytest.raises(error, match="expected real numbers"):
            otr.from_sb3(build(PPO, env, {"vf": [8]}, [4]), normalise=env)
