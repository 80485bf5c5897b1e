//! The table of releases, and the handle of a row.

use std::fmt;
use std::str::FromStr;

use super::backbone::BackboneRules;
use super::head::{COMMON_SIZES, Feature};
use super::n1::N1;
use super::n15::N15;
use super::n16::N16;
use super::n17::N17;
use super::row::Release;
use crate::error::{Error, Result, problem};

/// Every release, in their order.
const RELEASES: &[&Release] = &[
    &N1,
    &N15,
    &N16,
    &N17,
    #[cfg(test)]
    &super::made_up::N19,
];

/// A release of GR00T. It is shown as models are called, `N1.5`.
///
/// ```
/// use saccade_vla::Version;
/// let version: Version = "n1.5".parse()?;
/// assert_eq!((version, version.name(), version.to_string()), (Version::N15, "n1.5", "N1.5".to_owned()));
/// # Ok::<(), saccade_vla::Error>(())
/// ```
#[derive(Clone, Copy)]
pub struct Version(&'static Release);

impl Version {
    /// GR00T N1.
    pub const N1: Self = Self(&N1);
    /// GR00T N1.5.
    pub const N15: Self = Self(&N15);
    /// GR00T N1.6.
    pub const N16: Self = Self(&N16);
    /// GR00T N1.7.
    pub const N17: Self = Self(&N17);

    /// Every version, in the order of their release.
    pub fn all() -> impl Iterator<Item = Self> {
        RELEASES.iter().map(|release| Self(release))
    }

    /// Its name in configs and in Python: `n1.5`.
    #[must_use]
    pub fn name(self) -> &'static str {
        self.0.name
    }

    /// The version of this [`name`](Self::name).
    pub(crate) fn named(name: &str) -> Option<Self> {
        Self::all().find(|version| version.name() == name)
    }

    /// Its row.
    pub(crate) fn release(self) -> &'static Release {
        self.0
    }

    /// All versions whose backbones are known, with their rules.
    pub(crate) fn backbones() -> impl Iterator<Item = (Self, &'static BackboneRules)> {
        Self::all().filter_map(|version| Some((version, version.0.backbone.as_ref()?)))
    }

    /// All model types, to be shown.
    pub(crate) fn model_types() -> String {
        let names: Vec<_> = RELEASES.iter().map(|release| release.model_type).collect();
        names.join(", ")
    }

    /// Whether its config names `max_action_dim` and chooses its transformer by `use_alternate_vl_dit`.
    pub(crate) fn is_flat(self) -> bool {
        self.0.head.is_flat
    }

    pub(crate) fn has(self, feature: Feature) -> bool {
        self.0.head.features.contains(&feature)
    }

    /// The versions that have a feature.
    pub(crate) fn with(feature: Feature) -> Vec<Self> {
        Self::all().filter(|version| version.has(feature)).collect()
    }

    /// The size that the version's class takes for a key that its config leaves out; none if the config must
    /// name it.
    pub(crate) fn default_size(self, key: &str) -> Option<usize> {
        let mut sizes = self.0.head.sizes.iter().chain(&COMMON_SIZES);
        sizes.find(|(name, _)| *name == key).map(|(_, size)| *size)
    }

    /// The version of the model that is called this, in any spelling: `gr00t_n1_5`, `GR00T-N1.5`,
    /// `Gr00tN1d5`.
    ///
    /// The error says that it is a name of GR00T, and of none of the versions.
    pub(crate) fn of_model(name: &str) -> std::result::Result<Option<Self>, ()> {
        let plain: String = name
            .chars()
            .filter(char::is_ascii_alphanumeric)
            .map(|letter| letter.to_ascii_lowercase())
            .collect();
        let Some(number) = plain.strip_prefix("gr00t") else {
            return Ok(None);
        };
        let spelled = |version: &Self| {
            let name = version.name();
            number == name.replace('.', "") || number == name.replace('.', "d")
        };
        Self::all().find(spelled).map(Some).ok_or(())
    }

    /// The version whose name is in the path of a model, as lerobot finds it: `nvidia/GR00T-N1.5-3B`.
    pub(crate) fn in_path(path: &str) -> Option<Self> {
        let path = path.to_ascii_lowercase();
        let is_named = |version: &Self| {
            // `n1` is the beginning of all the others.
            version.name() != "n1"
                && ["gr00t-", "gr00t_"]
                    .iter()
                    .any(|start| path.contains(&format!("{start}{}", version.name())))
        };
        Self::all().find(is_named)
    }
}

/// The names of versions as a choice: `"n1.5", "n1.6" or "n1.7"`.
pub(crate) fn choice(versions: impl Iterator<Item = Version>) -> String {
    let names: Vec<String> = versions.map(|version| format!("{:?}", version.name())).collect();
    match names.split_last() {
        Some((last, others)) if !others.is_empty() => format!("{} or {last}", others.join(", ")),
        _ => names.concat(),
    }
}

impl PartialEq for Version {
    fn eq(&self, other: &Self) -> bool {
        self.name() == other.name()
    }
}

impl Eq for Version {}

impl fmt::Display for Version {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.name().to_uppercase())
    }
}

impl fmt::Debug for Version {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, formatter)
    }
}

impl FromStr for Version {
    type Err = Error;

    /// # Errors
    /// [`Error::Input`] if no version has this name.
    fn from_str(name: &str) -> Result<Self> {
        Self::named(name).ok_or_else(|| {
            Error::Input(problem!("version"; expected "{}", choice(Self::all()); got "{name:?}"))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn models_are_known_by_every_spelling() {
        for version in Version::all() {
            assert_eq!(Version::of_model(version.release().model_type), Ok(Some(version)));
        }
        for (name, version) in [
            ("GR00T-N1.5", Version::N15),
            ("gr00t_n1d5", Version::N15),
            ("Gr00tN1d6", Version::N16),
            ("GR00T_N1", Version::N1),
        ] {
            assert_eq!(Version::of_model(name), Ok(Some(version)));
        }
        assert_eq!(Version::of_model("bert"), Ok(None));
        assert_eq!(Version::of_model("gr00t_n2"), Err(()));
        assert_eq!(Version::in_path("nvidia/GR00T-N1.7-3B"), Some(Version::N17));
        assert_eq!(Version::in_path("nvidia/GR00T-N1-2B"), None);
    }
}
