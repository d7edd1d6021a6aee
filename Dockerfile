# vn_nav on an installed ROS 2 Jazzy (docs/installation.md).
#
#   docker build -t vn_nav .
#   docker run --rm vn_nav                                       # help
#   docker run --rm --shm-size 1g vn_nav ros2 launch vn_nav sim.launch.py
#   docker run --rm --ipc host --network host vn_nav ros2 run vn_nav policy_node    # beside a robot
#
# Fast DDS passes pictures in shared memory: Docker's 64 MB are too small for it.
# PIP_EXTRA_INDEX_URL: an index with CPU builds of PyTorch; else pip brings CUDA along.
FROM ros:jazzy
ARG PIP_EXTRA_INDEX_URL=

# Not root: nothing that a node writes is root's on a mounted folder.
ENV WORKSPACE=/home/robot/ws
RUN useradd --create-home --shell /bin/bash robot \
    && install -d -o robot -g robot "$WORKSPACE" "$WORKSPACE/src" "$WORKSPACE/src/vn_nav"
WORKDIR $WORKSPACE

# What rosdep knows comes from apt, except what pip has newer below. Before the sources: a change of
# those does not install it again.
COPY --chown=robot package.xml src/vn_nav/package.xml
COPY --chown=robot vn_interfaces/package.xml src/vn_nav/vn_interfaces/package.xml
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3-pip python3-venv \
    && rosdep update --rosdistro jazzy \
    && rosdep install --from-paths src src/vn_nav/vn_interfaces --ignore-src -y \
        --rosdistro jazzy --dependency-types buildtool --dependency-types build \
        --dependency-types exec --skip-keys "python3-gymnasium-pip python3-numba python3-numpy \
        python3-onnxruntime-pip python3-opencv python3-rich python3-rosbags-pip python3-torch" \
    && rm -rf /var/lib/apt/lists/*

USER robot
# A virtual environment that sees the system's ROS, with the versions that were tested together.
COPY --chown=robot constraints.txt src/vn_nav/constraints.txt
ENV VIRTUAL_ENV=/home/robot/venv
ENV PATH=$VIRTUAL_ENV/bin:$PATH
RUN python3 -m venv --system-site-packages "$VIRTUAL_ENV" \
    && python -m pip install --no-cache-dir -c src/vn_nav/constraints.txt \
        numpy opencv-python-headless torch safetensors gymnasium numba PyYAML rich mcap \
        zstandard lz4 rosbags

# `python -m colcon`: the executables start with the environment's interpreter.
COPY --chown=robot . src/vn_nav
RUN . /opt/ros/jazzy/setup.bash \
    && python -m colcon build --base-paths src src/vn_nav/vn_interfaces

ENTRYPOINT ["/bin/bash", "-c", "source \"$WORKSPACE/install/setup.bash\" && exec \"$@\"", "--"]
CMD ["ros2", "run", "vn_nav", "vn_nav", "--help"]
