"""SBX's SAC on Hopper for `benchmarks/fleet.py`; runs in an environment of its own, and prints steps per CPU-second."""

import json
import os
import sys
import time

for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import gymnasium as gym  # noqa: E402
import numpy as np  # noqa: E402
from sbx import SAC  # noqa: E402
from stable_baselines3.common.noise import NormalActionNoise  # noqa: E402

settings = json.loads(sys.argv[1])
env = gym.make("Hopper-v4", disable_env_checker=True)
n_actions = len(env.action_space.low)
model = SAC(
    "MlpPolicy",
    env,
    learning_rate=settings["learning_rate"],
    batch_size=settings["batch_size"],
    gamma=settings["gamma"],
    tau=settings["tau"],
    learning_starts=settings["n_random"],
    buffer_size=100_000,
    action_noise=NormalActionNoise(np.zeros(n_actions), np.full(n_actions, 0.1)),
    policy_kwargs={"net_arch": {"pi": [6], "qf": settings["critic"]}},
    seed=0,
)
model.learn(settings["n_random"] + settings["n_ahead"])
start, began = model.num_timesteps, time.process_time()
model.learn(settings["n_steps"], reset_num_timesteps=False)
print((model.num_timesteps - start) / (time.process_time() - began))
