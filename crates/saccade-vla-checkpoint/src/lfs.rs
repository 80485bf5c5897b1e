//! Git LFS pointers: what a clone holds in place of large files that were not downloaded.

use std::path::Path;

/// How the text of a pointer begins.
const START: &[u8] = b"version https://git-lfs.github.com/spec/v1";

/// Bytes of a file that tell a pointer.
pub(crate) const TELLING: usize = START.len();

/// What is wrong with the file `path`, which begins with `bytes`, if it is a pointer.
pub(crate) fn pointer_problem(path: &Path, bytes: &[u8]) -> Option<String> {
    let folder = match path.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    };
    bytes.starts_with(START).then(|| {
        format!(
            "it is a Git LFS pointer, not the file itself: run `git lfs pull` in {}, or download the repository with `hf download`",
            folder.display()
        )
    })
}
