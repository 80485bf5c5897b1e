//! Names and shapes of the head's tensors: the one place that knows them. All else asks for a part by what it is.

use std::ops::Range;

use saccade_checkpoint::{TensorSpec, Wanted};

use crate::config::HeadConfig;

/// `weight (out_features, in_features)` and `bias (out_features)`.
#[derive(Clone, Debug)]
pub(crate) struct LinearNames {
    pub weight: String,
    pub bias: String,
    pub in_features: usize,
    pub out_features: usize,
    pub role: Role,
}

/// What a layer is to the head's cost, which decides how precisely it is worth computing: see [`Precision`](crate::Precision).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Role {
    /// Attention and feed-forward of the blocks: nearly all of the work.
    Block,
    /// Of time alone, so computed once a bucket.
    Time,
    /// Encoders, decoder and output: under one percent.
    Other,
}

/// One linear layer per embodiment: `W (num_embodiments, in_features, out_features)` and `b (num_embodiments, out_features)`.
#[derive(Clone, Debug)]
pub(crate) struct CategoryLinearNames {
    pub weight: String,
    pub bias: String,
    pub num_embodiments: usize,
    pub in_features: usize,
    pub out_features: usize,
}

/// `weight (width)` and `bias (width)` of an affine norm.
#[derive(Clone, Debug)]
pub(crate) struct NormNames {
    pub weight: String,
    pub bias: String,
    pub width: usize,
}

/// The projections of one attention.
#[derive(Clone, Debug)]
pub(crate) struct AttentionNames {
    pub to_q: LinearNames,
    pub to_k: LinearNames,
    pub to_v: LinearNames,
    pub to_out: LinearNames,
}

/// The two layers of a feed-forward.
#[derive(Clone, Debug)]
pub(crate) struct FeedForwardNames {
    pub proj: LinearNames,
    pub out: LinearNames,
}

/// A block of the VL self-attention.
#[derive(Clone, Debug)]
pub(crate) struct VlBlockNames {
    pub norm1: NormNames,
    pub attention: AttentionNames,
    pub norm3: NormNames,
    pub feed_forward: FeedForwardNames,
}

/// A block of the diffusion transformer.
#[derive(Clone, Debug)]
pub(crate) struct DitBlockNames {
    pub modulation: LinearNames,
    pub attention: AttentionNames,
    pub feed_forward: FeedForwardNames,
}

/// Every tensor of a head.
#[derive(Clone, Debug)]
pub(crate) struct HeadNames {
    pub vlln: Option<NormNames>,
    pub vl_blocks: Vec<VlBlockNames>,
    pub state_encoder: [CategoryLinearNames; 2],
    pub action_encoder: [CategoryLinearNames; 3],
    /// One for each of [`HeadConfig::decoders`].
    pub decoders: Vec<[CategoryLinearNames; 2]>,
    /// `(num_future_tokens, width)`.
    pub future_tokens: (String, Vec<usize>),
    /// `(max_positions, width)`.
    pub position_embedding: Option<(String, Vec<usize>)>,
    pub timestep_embedder: [LinearNames; 2],
    pub blocks: Vec<DitBlockNames>,
    pub proj_out: [LinearNames; 2],
}

/// Name, without a prefix, and shape of every tensor that a head's checkpoint must hold.
#[must_use]
pub fn tensor_shapes(config: &HeadConfig) -> Vec<(String, Vec<usize>)> {
    let tensors = tensor_specs(config);
    tensors
        .into_iter()
        // A head without future tokens may come with an empty tensor of them, and need not.
        .filter(|tensor| !tensor.shape.contains(&0))
        .map(|tensor| (tensor.name, tensor.shape))
        .collect()
}

/// Every tensor that a checkpoint of a head of this config must hold, by its name without a prefix.
pub(crate) fn tensor_specs(config: &HeadConfig) -> Vec<TensorSpec> {
    HeadNames::new(config).tensors()
}

/// The name, without a prefix, of the future tokens.
pub(crate) const FUTURE_TOKENS: &str = "future_tokens.weight";

/// Whether a head of this config may come with a tensor `name`, without a prefix, of this shape, that only its training uses: the forks'
/// logarithms of loss weights, what N1.6 puts in place of a state that it hides, how often N1.7 hides one.
pub(crate) fn is_unused(config: &HeadConfig, name: &str, shape: &[usize]) -> bool {
    match name {
        "mask_token" => shape == [1, 1, config.width],
        "dropout_prob_by_embodiment" => shape == [config.num_embodiments],
        _ => name.starts_with("task_log_sigma.") && shape.iter().all(|&size| size == 1),
    }
}

/// Width of the sinusoidal table of the time embedding.
pub(crate) const TIME_CHANNELS: usize = 256;

impl HeadNames {
    pub(crate) fn new(config: &HeadConfig) -> Self {
        let (width, hidden) = (config.width, config.hidden_dim);
        let category = |name: &str, layer: &str, in_features, out_features| CategoryLinearNames {
            weight: format!("{name}.{layer}.W"),
            bias: format!("{name}.{layer}.b"),
            num_embodiments: config.num_embodiments,
            in_features,
            out_features,
        };
        let actions = config.encoder_action_dim;
        Self {
            vlln: config
                .use_vlln
                .then(|| NormNames::new("vlln", config.context_dim)),
            vl_blocks: (0..config.vl_num_layers)
                .map(|index| VlBlockNames::new(config, index))
                .collect(),
            state_encoder: [
                category(
                    "state_encoder",
                    "layer1",
                    config.state_dim * config.state_history,
                    hidden,
                ),
                category("state_encoder", "layer2", hidden, width),
            ],
            action_encoder: [
                category("action_encoder", "W1", actions, width),
                category("action_encoder", "W2", 2 * width, width),
                category("action_encoder", "W3", width, width),
            ],
            decoders: config
                .decoders
                .iter()
                .map(|(name, width)| {
                    [
                        category(name, "layer1", hidden, hidden),
                        category(name, "layer2", hidden, *width),
                    ]
                })
                .collect(),
            future_tokens: (FUTURE_TOKENS.to_owned(), vec![config.num_future_tokens, width]),
            position_embedding: config.add_pos_embed.then(|| {
                (
                    "position_embedding.weight".to_owned(),
                    vec![config.max_positions, width],
                )
            }),
            timestep_embedder: [
                LinearNames::new(
                    "model.timestep_encoder.timestep_embedder.linear_1",
                    Role::Time,
                    TIME_CHANNELS,
                    width,
                ),
                LinearNames::new(
                    "model.timestep_encoder.timestep_embedder.linear_2",
                    Role::Time,
                    width,
                    width,
                ),
            ],
            blocks: (0..config.num_layers)
                .map(|index| DitBlockNames::new(config, index))
                .collect(),
            proj_out: [
                LinearNames::new("model.proj_out_1", Role::Time, width, 2 * width),
                LinearNames::new("model.proj_out_2", Role::Other, width, hidden),
            ],
        }
    }

    /// Every tensor.
    pub(crate) fn tensors(&self) -> Vec<TensorSpec> {
        let mut tensors = vec![TensorSpec::plain(&self.future_tokens.0, &self.future_tokens.1)];
        if let Some((name, shape)) = &self.position_embedding {
            tensors.push(TensorSpec::plain(name, shape));
        }
        if let Some(norm) = &self.vlln {
            norm.list(&mut tensors);
        }
        for block in &self.vl_blocks {
            block.list(&mut tensors);
        }
        for layer in self
            .state_encoder
            .iter()
            .chain(&self.action_encoder)
            .chain(self.decoders.iter().flatten())
        {
            layer.list(&mut tensors);
        }
        for block in &self.blocks {
            block.list(&mut tensors);
        }
        for layer in self.timestep_embedder.iter().chain(&self.proj_out) {
            layer.list(&mut tensors);
        }
        tensors
    }

    /// What a head with these embodiments reads, in the order in which it is loaded: [`ActionHead::load`](crate::ActionHead::load) asks
    /// for the same.
    pub(crate) fn reading_order(&self, config: &HeadConfig, embodiment_ids: &[usize]) -> Vec<Wanted> {
        let mut order = Vec::new();
        let whole = |order: &mut Vec<Wanted>, list: &dyn Fn(&mut Vec<TensorSpec>)| {
            let mut tensors = Vec::new();
            list(&mut tensors);
            order.extend(tensors.into_iter().map(|spec| Wanted {
                is_given_back: spec.may_be_int8,
                ..wanted(spec.name)
            }));
        };
        let slices = |order: &mut Vec<Wanted>, layers: &[CategoryLinearNames]| {
            for &id in embodiment_ids {
                for name in layers.iter().flat_map(|layer| [&layer.weight, &layer.bias]) {
                    order.push(wanted_slices(name, id..id + 1));
                }
            }
        };
        if let Some(norm) = &self.vlln {
            whole(&mut order, &|tensors| norm.list(tensors));
        }
        for block in &self.vl_blocks {
            whole(&mut order, &|tensors| block.list(tensors));
        }
        for layer in &self.state_encoder {
            slices(&mut order, std::slice::from_ref(layer));
        }
        let [fused @ .., last] = &self.action_encoder;
        slices(&mut order, fused);
        slices(&mut order, std::slice::from_ref(last));
        if config.num_future_tokens > 0 {
            order.push(wanted(self.future_tokens.0.clone()));
        }
        if let Some((name, _)) = &self.position_embedding {
            order.push(wanted_slices(name, 0..config.action_horizon));
        }
        for layer in &self.timestep_embedder {
            whole(&mut order, &|tensors| layer.list(tensors));
        }
        for block in &self.blocks {
            whole(&mut order, &|tensors| block.list(tensors));
        }
        for layer in &self.proj_out {
            whole(&mut order, &|tensors| layer.list(tensors));
        }
        for layer in self.decoders.iter().flatten() {
            slices(&mut order, std::slice::from_ref(layer));
        }
        order
    }
}

fn wanted(name: String) -> Wanted {
    Wanted {
        name,
        slices: None,
        is_given_back: false,
    }
}

fn wanted_slices(name: &str, slices: Range<usize>) -> Wanted {
    Wanted {
        slices: Some(slices),
        ..wanted(name.to_owned())
    }
}

impl LinearNames {
    fn new(name: &str, role: Role, in_features: usize, out_features: usize) -> Self {
        Self {
            weight: format!("{name}.weight"),
            bias: format!("{name}.bias"),
            in_features,
            out_features,
            role,
        }
    }

    fn list(&self, tensors: &mut Vec<TensorSpec>) {
        tensors.push(TensorSpec {
            may_be_int8: self.role == Role::Block,
            ..TensorSpec::plain(&self.weight, &[self.out_features, self.in_features])
        });
        tensors.push(TensorSpec::plain(&self.bias, &[self.out_features]));
    }
}

impl CategoryLinearNames {
    fn list(&self, tensors: &mut Vec<TensorSpec>) {
        let weight = [self.num_embodiments, self.in_features, self.out_features];
        let bias = [self.num_embodiments, self.out_features];
        for (name, shape) in [(&self.weight, &weight[..]), (&self.bias, &bias)] {
            tensors.push(TensorSpec {
                per_embodiment: true,
                ..TensorSpec::plain(name, shape)
            });
        }
    }
}

impl NormNames {
    fn new(name: &str, width: usize) -> Self {
        Self {
            weight: format!("{name}.weight"),
            bias: format!("{name}.bias"),
            width,
        }
    }

    fn list(&self, tensors: &mut Vec<TensorSpec>) {
        tensors.push(TensorSpec::plain(&self.weight, &[self.width]));
        tensors.push(TensorSpec::plain(&self.bias, &[self.width]));
    }
}

impl AttentionNames {
    /// `path` with its final dot, or empty for an attention on its own.
    pub(crate) fn new(path: &str, width: usize, context_dim: usize) -> Self {
        Self {
            to_q: LinearNames::new(&format!("{path}to_q"), Role::Block, width, width),
            to_k: LinearNames::new(&format!("{path}to_k"), Role::Block, context_dim, width),
            to_v: LinearNames::new(&format!("{path}to_v"), Role::Block, context_dim, width),
            to_out: LinearNames::new(&format!("{path}to_out.0"), Role::Block, width, width),
        }
    }

    fn list(&self, tensors: &mut Vec<TensorSpec>) {
        for layer in [&self.to_q, &self.to_k, &self.to_v, &self.to_out] {
            layer.list(tensors);
        }
    }

    /// Every tensor.
    pub(crate) fn tensors(&self) -> Vec<TensorSpec> {
        let mut tensors = Vec::new();
        self.list(&mut tensors);
        tensors
    }
}

impl FeedForwardNames {
    fn new(path: &str, width: usize) -> Self {
        Self {
            proj: LinearNames::new(&format!("{path}.ff.net.0.proj"), Role::Block, width, 4 * width),
            out: LinearNames::new(&format!("{path}.ff.net.2"), Role::Block, 4 * width, width),
        }
    }

    fn list(&self, tensors: &mut Vec<TensorSpec>) {
        self.proj.list(tensors);
        self.out.list(tensors);
    }
}

impl VlBlockNames {
    fn new(config: &HeadConfig, index: usize) -> Self {
        let path = format!("vl_self_attention.transformer_blocks.{index}");
        let width = config.context_dim;
        Self {
            norm1: NormNames::new(&format!("{path}.norm1"), width),
            attention: AttentionNames::new(&format!("{path}.attn1."), width, width),
            norm3: NormNames::new(&format!("{path}.norm3"), width),
            feed_forward: FeedForwardNames::new(&path, width),
        }
    }

    fn list(&self, tensors: &mut Vec<TensorSpec>) {
        self.norm1.list(tensors);
        self.attention.list(tensors);
        self.norm3.list(tensors);
        self.feed_forward.list(tensors);
    }
}

impl DitBlockNames {
    fn new(config: &HeadConfig, index: usize) -> Self {
        let path = format!("model.transformer_blocks.{index}");
        let keys_from = if config.is_cross(index) {
            config.context_dim
        } else {
            config.width
        };
        Self {
            modulation: LinearNames::new(
                &format!("{path}.norm1.linear"),
                Role::Time,
                config.width,
                2 * config.width,
            ),
            attention: AttentionNames::new(&format!("{path}.attn1."), config.width, keys_from),
            feed_forward: FeedForwardNames::new(&path, config.width),
        }
    }

    fn list(&self, tensors: &mut Vec<TensorSpec>) {
        self.modulation.list(tensors);
        self.attention.list(tensors);
        self.feed_forward.list(tensors);
    }
}
