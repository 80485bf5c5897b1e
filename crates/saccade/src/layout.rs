//! Names and shapes of the head's tensors: the one place that knows them. All else asks for a part by what it is.

use crate::config::HeadConfig;

/// `weight (out_features, in_features)` and `bias (out_features)`.
#[derive(Clone, Debug)]
pub(crate) struct LinearNames {
    pub weight: String,
    pub bias: String,
    pub in_features: usize,
    pub out_features: usize,
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
    pub action_decoder: [CategoryLinearNames; 2],
    /// `(num_future_tokens, width)`.
    pub future_tokens: (String, Vec<usize>),
    /// `(max_positions, width)`.
    pub position_embedding: Option<(String, Vec<usize>)>,
    pub timestep_embedder: [LinearNames; 2],
    pub blocks: Vec<DitBlockNames>,
    pub proj_out: [LinearNames; 2],
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
            action_decoder: [
                category("action_decoder", "layer1", hidden, hidden),
                category("action_decoder", "layer2", hidden, config.action_dim),
            ],
            future_tokens: (
                "future_tokens.weight".to_owned(),
                vec![config.num_future_tokens, width],
            ),
            position_embedding: config.add_pos_embed.then(|| {
                (
                    "position_embedding.weight".to_owned(),
                    vec![config.max_positions, width],
                )
            }),
            timestep_embedder: [
                LinearNames::new(
                    "model.timestep_encoder.timestep_embedder.linear_1",
                    TIME_CHANNELS,
                    width,
                ),
                LinearNames::new("model.timestep_encoder.timestep_embedder.linear_2", width, width),
            ],
            blocks: (0..config.num_layers)
                .map(|index| DitBlockNames::new(config, index))
                .collect(),
            proj_out: [
                LinearNames::new("model.proj_out_1", width, 2 * width),
                LinearNames::new("model.proj_out_2", width, hidden),
            ],
        }
    }

    /// Name and shape of every tensor.
    pub(crate) fn tensors(&self) -> Vec<(String, Vec<usize>)> {
        let mut tensors = vec![self.future_tokens.clone()];
        tensors.extend(self.position_embedding.clone());
        if let Some(norm) = &self.vlln {
            norm.list(&mut tensors);
        }
        for block in &self.vl_blocks {
            block.norm1.list(&mut tensors);
            block.attention.list(&mut tensors);
            block.norm3.list(&mut tensors);
            block.feed_forward.list(&mut tensors);
        }
        for layer in self
            .state_encoder
            .iter()
            .chain(&self.action_encoder)
            .chain(&self.action_decoder)
        {
            layer.list(&mut tensors);
        }
        for block in &self.blocks {
            block.modulation.list(&mut tensors);
            block.attention.list(&mut tensors);
            block.feed_forward.list(&mut tensors);
        }
        for layer in self.timestep_embedder.iter().chain(&self.proj_out) {
            layer.list(&mut tensors);
        }
        tensors
    }
}

impl LinearNames {
    fn new(name: &str, in_features: usize, out_features: usize) -> Self {
        Self {
            weight: format!("{name}.weight"),
            bias: format!("{name}.bias"),
            in_features,
            out_features,
        }
    }

    fn list(&self, tensors: &mut Vec<(String, Vec<usize>)>) {
        tensors.push((self.weight.clone(), vec![self.out_features, self.in_features]));
        tensors.push((self.bias.clone(), vec![self.out_features]));
    }
}

impl CategoryLinearNames {
    fn list(&self, tensors: &mut Vec<(String, Vec<usize>)>) {
        tensors.push((
            self.weight.clone(),
            vec![self.num_embodiments, self.in_features, self.out_features],
        ));
        tensors.push((self.bias.clone(), vec![self.num_embodiments, self.out_features]));
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

    fn list(&self, tensors: &mut Vec<(String, Vec<usize>)>) {
        tensors.push((self.weight.clone(), vec![self.width]));
        tensors.push((self.bias.clone(), vec![self.width]));
    }
}

impl AttentionNames {
    /// `path` with its final dot, or empty for an attention on its own.
    pub(crate) fn new(path: &str, width: usize, context_dim: usize) -> Self {
        Self {
            to_q: LinearNames::new(&format!("{path}to_q"), width, width),
            to_k: LinearNames::new(&format!("{path}to_k"), context_dim, width),
            to_v: LinearNames::new(&format!("{path}to_v"), context_dim, width),
            to_out: LinearNames::new(&format!("{path}to_out.0"), width, width),
        }
    }

    fn list(&self, tensors: &mut Vec<(String, Vec<usize>)>) {
        for layer in [&self.to_q, &self.to_k, &self.to_v, &self.to_out] {
            layer.list(tensors);
        }
    }

    /// Name and shape of every tensor.
    pub(crate) fn tensors(&self) -> Vec<(String, Vec<usize>)> {
        let mut tensors = Vec::new();
        self.list(&mut tensors);
        tensors
    }
}

impl FeedForwardNames {
    fn new(path: &str, width: usize) -> Self {
        Self {
            proj: LinearNames::new(&format!("{path}.ff.net.0.proj"), width, 4 * width),
            out: LinearNames::new(&format!("{path}.ff.net.2"), 4 * width, width),
        }
    }

    fn list(&self, tensors: &mut Vec<(String, Vec<usize>)>) {
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
            modulation: LinearNames::new(&format!("{path}.norm1.linear"), config.width, 2 * config.width),
            attention: AttentionNames::new(&format!("{path}.attn1."), config.width, keys_from),
            feed_forward: FeedForwardNames::new(&path, config.width),
        }
    }
}
