"""What a clone holds in place of a large file that was not downloaded."""

POINTER = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 15881149\n"
