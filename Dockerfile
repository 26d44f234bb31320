# docker build -t otr . && docker run --rm --user "$(id -u)" -v "$PWD:/w" otr otr-run env=CartPole-v1 model=/w/policy.zip
FROM python:3.11-slim
# HOME: caches of whatever user the container is started as.
ENV OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MUJOCO_GL=egl HOME=/tmp
RUN apt-get update && apt-get install --yes --no-install-recommends libegl1 libgl1 && rm -rf /var/lib/apt/lists/*
# TORCH_INDEX: the index of torch's builds without CUDA, which pytorch.org names; the image is then some 4 GB smaller.
ARG TORCH_INDEX=""
COPY constraints.txt /otr/
RUN pip install --no-cache-dir -c /otr/constraints.txt ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} torch
COPY . /otr
RUN pip install --no-cache-dir -c /otr/constraints.txt '/otr[run,onnx,hub]'
WORKDIR /w
CMD ["otr-run", "--help"]
