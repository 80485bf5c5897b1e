//! JSON objects in which no key is repeated.

use std::collections::BTreeSet;

use serde::de::{Deserialize, Deserializer, IgnoredAny, MapAccess, Visitor};

/// The key under which a safetensors header describes its file.
pub(crate) const METADATA: &str = "__metadata__";

/// A JSON object from names to values, in the order of the file. Names that are repeated (the usual map types silently keep the last one) or
/// hold control characters are errors. What a safetensors file says of itself, `__metadata__`, is left out.
pub struct UniqueMap<T>(pub Vec<(String, T)>);

impl<'de, T: Deserialize<'de>> Deserialize<'de> for UniqueMap<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        struct Entries<T>(std::marker::PhantomData<T>);
        impl<'de, T: Deserialize<'de>> Visitor<'de> for Entries<T> {
            type Value = UniqueMap<T>;

            fn expecting(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                formatter.write_str("a JSON object")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> std::result::Result<Self::Value, A::Error> {
                let mut seen = BTreeSet::new();
                let mut entries = Vec::new();
                while let Some(key) = map.next_key::<String>()? {
                    let bad = |problem: String| Err(serde::de::Error::custom(problem));
                    if !seen.insert(key.clone()) {
                        return bad(format!("{key} appears twice"));
                    }
                    if key.chars().any(char::is_control) {
                        return bad(format!("the name {key:?} holds control characters"));
                    }
                    if key == METADATA {
                        map.next_value::<IgnoredAny>()?;
                        continue;
                    }
                    match map.next_value() {
                        Ok(value) => entries.push((key, value)),
                        Err(error) => return bad(format!("{key}: {error}")),
                    }
                }
                Ok(UniqueMap(entries))
            }
        }
        deserializer.deserialize_map(Entries(std::marker::PhantomData))
    }
}
