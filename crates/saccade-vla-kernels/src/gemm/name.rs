//! Names of kernels, joined at compile time.

/// The longest name.
const MAX: usize = 32;

/// Parts of a name with hyphens in between.
pub(super) struct Joined {
    bytes: [u8; MAX],
    len: usize,
}

impl Joined {
    const EMPTY: Self = Self {
        bytes: [0; MAX],
        len: 0,
    };

    /// The name and one part more, unless that is empty.
    const fn with(mut self, part: &str) -> Self {
        let part = part.as_bytes();
        if !part.is_empty() && self.len > 0 {
            self.bytes[self.len] = b'-';
            self.len += 1;
        }
        let mut index = 0;
        while index < part.len() {
            self.bytes[self.len] = part[index];
            self.len += 1;
            index += 1;
        }
        self
    }

    pub(super) const fn as_str(&self) -> &str {
        match std::str::from_utf8(self.bytes.split_at(self.len).0) {
            Ok(text) => text,
            Err(_) => unreachable!(),
        }
    }
}

/// `vectors-dots-elements`, without parts that are empty.
pub(super) const fn join(vectors: &str, dots: &str, elements: &str) -> Joined {
    Joined::EMPTY.with(vectors).with(dots).with(elements)
}
