#!/bin/sh
# Builds the library of vla.cpp from a clone, against the ggml that build_ggml.sh built: build_vla.sh FOLDER
# CLONE. The library, its scripts and Python's gguf are written to FOLDER/vla. Its server, which needs
# ZeroMQ and protobuf, is not built.
set -eu
folder=$(cd "$1" && pwd)
clone=$(cd "$2" && pwd)
llama="$folder/ggml/source/vendor/llama.cpp"
libraries="$folder/ggml/build/bin"
rm -rf "$folder/vla" && mkdir -p "$folder/vla/objects"
cd "$folder/vla"
for source in model loader options vla_c_api modules/* models/*; do
    for file in "$clone"/src/${source%.*}.cpp; do
        [ -e "$file" ] || continue
        # Two folders may have files of the same name.
        object=$(printf %s "${file#"$clone"/src/}" | tr / -).o
        # As CMake's release build of it; -march=native as in ggml.
        c++ -std=c++17 -O3 -DNDEBUG -march=native -fPIC -I "$clone/src" -I "$clone/include" -I "$llama/vendor" \
            -I "$llama/ggml/include" -c "$file" -o "objects/$object"
    done
done
c++ -shared -o libvla.so objects/*.o -L "$libraries" -lggml -lggml-base -lggml-cpu "-Wl,-rpath,$libraries"
cp -r "$clone/scripts" scripts
echo "commit $(git -C "$clone" describe --always --dirty --exclude "*"), $(basename "$folder"/ggml/llama_cpp_python-*.tar.gz .tar.gz)" >version.txt
cp -r "$llama/gguf-py" gguf-py
