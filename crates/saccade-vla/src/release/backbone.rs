//! The rules of a release's backbone: what its parts are called in a checkpoint, what its classes do, and the
//! sizes it was published with.

/// The rules of a backbone.
pub(crate) struct BackboneRules {
    pub names: Names,
    /// Its published sizes, in the keys of `config.json`.
    pub sizes: &'static str,
    pub tower: TowerKind,
    pub has_final_norm: bool,
}

/// What the parts are called in a checkpoint, below the prefix of the backbone.
#[derive(Clone, Copy)]
pub(crate) struct Names {
    pub vision: &'static str,
    /// Behind the tower; none if it is a part of it.
    pub connector: Option<&'static str>,
    pub language: &'static str,
    /// The twin of the embedding table.
    pub lm_head: &'static str,
    /// The last layer, if `project_to_dim` asks for one.
    pub projection: &'static str,
}

/// The tower of a release, before its sizes are known.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum TowerKind {
    Siglip {
        pixels: PixelOrder,
        patches: PatchOrder,
        /// Whether all views have the size of the table of positions.
        is_fixed: bool,
    },
    Qwen3Vl,
}

/// The order of the pixels in a patch, last axis fastest.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PixelOrder {
    /// Channel, row, column.
    ChannelFirst,
    /// Row, column, channel.
    ChannelLast,
}

/// The order of the elements of the square of patches that makes a token, last axis fastest.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PatchOrder {
    /// Row, column, element of the patch.
    PatchFirst,
    /// Element of the patch, row, column.
    PatchLast,
}

impl BackboneRules {
    /// The beginnings of the names of all tensors of the vision tower and of the language model.
    pub(crate) fn marks(&self) -> [String; 2] {
        [self.names.vision, self.names.language].map(|name| format!("{name}."))
    }
}
