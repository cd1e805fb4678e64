# Images from the pins of requirements.lock. The command is `playslot`; runs and data belong in /work, a volume.
#   docker build --target cpu --tag playslot .
#   docker build --target cuda --tag playslot:cuda .
#   docker run --rm --volume "$PWD:/work" playslot demo
#   docker run --rm --gpus all --volume "$PWD:/work" playslot:cuda doctor

FROM python:3.12-slim AS build
ENV VIRTUAL_ENV=/opt/playslot PATH=/opt/playslot/bin:$PATH UV_NO_CACHE=1
RUN python -m venv /opt/playslot && pip install --no-cache-dir uv==0.13.8
WORKDIR /source
# Packages first: a change of the code does not fetch them again.
COPY requirements.lock ./
RUN uv pip install --compile-bytecode --require-hashes --requirement requirements.lock
COPY pyproject.toml README.md LICENSE ./
COPY playslot_rl playslot_rl
COPY envs envs
COPY collectors collectors
COPY recipes recipes
COPY lerobot_policy_playslot lerobot_policy_playslot
RUN uv pip install --compile-bytecode --no-deps --no-build-isolation . ./lerobot_policy_playslot

# The pinned torch has CUDA in it. An index of builds without makes the CPU image some gigabytes smaller:
#   docker build --target cpu --build-arg TORCH_INDEX=URL --tag playslot .
FROM build AS build-cpu
ARG TORCH_INDEX=""
RUN if [ -n "$TORCH_INDEX" ]; then \
      uv pip install --no-deps --reinstall --index-url "$TORCH_INDEX" $(grep -oE '^(torch|torchvision)==[0-9.]+' requirements.lock) \
      && uv pip uninstall $(uv pip freeze | grep -oE '^(nvidia-[^=]+|cuda-[^=]+|triton)'); \
    fi

# What draws the simulators, and a user who is not root.
FROM python:3.12-slim AS machine
RUN apt-get update \
    && apt-get install --yes --no-install-recommends git libegl1 libgl1 libosmesa6 \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --create-home --uid 1000 playslot \
    && install --directory --owner playslot /work
ENV PATH=/opt/playslot/bin:$PATH MUJOCO_GL=egl PYTHONUNBUFFERED=1
USER playslot
WORKDIR /work
VOLUME /work
ENTRYPOINT ["playslot"]
CMD ["--help"]

FROM machine AS cpu
COPY --from=build-cpu /opt/playslot /opt/playslot

# The driver is the host's, by its container toolkit; `graphics` draws the simulators on the GPU.
FROM machine AS cuda
ENV NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics
COPY --from=build /opt/playslot /opt/playslot
