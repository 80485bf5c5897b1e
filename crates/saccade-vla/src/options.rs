//! Setters of options.

/// Setters `with_FIELD(self, FIELD) -> Self`, one a line.
macro_rules! setters {
    ($($(#[$doc:meta])* $setter:ident($field:ident: $value:ty);)*) => {$(
        $(#[$doc])*
        #[must_use]
        pub fn $setter(self, $field: $value) -> Self {
            Self { $field: $field.into(), ..self }
        }
    )*};
}

pub(crate) use setters;
