#!/bin/sh
# Builds ggml from the sources in llama-cpp-python's source package: build_ggml.sh FOLDER. The libraries are
# written to FOLDER/ggml/build/bin. cmake, ninja and python are those on PATH.
set -eu
folder=$(cd "$1" && pwd)
requirement=llama-cpp-python==0.3.36
mkdir -p "$folder/ggml"
cd "$folder/ggml"
python -m pip --disable-pip-version-check download --quiet --no-deps --no-binary llama-cpp-python "$requirement"
rm -rf source build && mkdir source
tar xzf llama_cpp_python-*.tar.gz --strip-components 1 -C source
# llama.cpp's own options for the CPU: native instruction set, llamafile's products, OpenMP.
cmake -S source/vendor/llama.cpp -B build -G Ninja -DCMAKE_BUILD_TYPE=Release -DGGML_CCACHE=OFF \
    -DLLAMA_BUILD_TESTS=OFF -DLLAMA_BUILD_EXAMPLES=OFF -DLLAMA_BUILD_TOOLS=OFF -DLLAMA_BUILD_SERVER=OFF >cmake.log
cmake --build build --target ggml >build.log
