//! Another number of future tokens: merging by the public rule, and what becomes of a config.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};

use saccade_vla::files::{Checkpoint, CheckpointWriter, Companions, Dtype, PlannedTensor};
use saccade_vla::{
    Error, HeadConfig, MergedTokens, ResizeOptions, ResizeReport, RewriteOptions, merge_future_tokens,
    resize, resized_config, tensor_shapes,
};
use serde_json::{Value, json};

const CONFIG: &str = r#"{
  "action_head_cfg": {
    "action_dim": 3, "action_horizon": 5, "add_pos_embed": true, "backbone_embedding_dim": 8, "hidden_size": 7,
    "input_embedding_dim": 12, "max_state_dim": 6, "noise_s": 0.99900000000000000001, "num_inference_timesteps": 4,
    "num_target_vision_tokens": 4, "num_timestep_buckets": 1000, "use_vlln": false,
    "diffusion_model_cfg": {"num_layers": 2, "num_attention_heads": 3, "attention_head_dim": 4, "positional_embeddings": null, "cross_attention_dim": 8, "interleave_self_attention": true}
  },
  "model_type": "gr00t_n1_5", "extra": [{"num_target_vision_tokens": 4}]
}"#;

/// The width of its future tokens.
const WIDTH: usize = 12;

/// A directory of checkpoints, removed at the end.
struct Directory(PathBuf);

impl Directory {
    fn new() -> Self {
        static COUNTER: AtomicUsize = AtomicUsize::new(0);
        let number = COUNTER.fetch_add(1, Ordering::Relaxed);
        Self(std::env::temp_dir().join(format!("saccade-resized-{}-{number}", std::process::id())))
    }

    /// Writes the checkpoint `name` of a head of the sizes in `sizes`, with `config` beside its tensors, whose
    /// names begin with `prefix`.
    fn write(&self, name: &str, sizes: &str, config: &str, prefix: &str) {
        let shapes = tensor_shapes(&HeadConfig::from_json(sizes).unwrap()).unwrap();
        let planned: Vec<PlannedTensor> = shapes
            .into_iter()
            .map(|(name, shape)| PlannedTensor {
                name: format!("{prefix}{name}"),
                dtype: Dtype::F32,
                shape,
            })
            .collect();
        let (out, none) = (self.0.join(name), Companions::default());
        let mut writer =
            CheckpointWriter::create(&out, planned.clone(), &BTreeMap::new(), &none, u64::MAX, false)
                .unwrap();
        writer.file("config.json", config).unwrap();
        for tensor in planned {
            let numbers = (0..tensor.nbytes() / 4).map(|index| (index * 37 % 101) as f32 / 500.0 - 0.1);
            let bytes: Vec<u8> = numbers.flat_map(f32::to_le_bytes).collect();
            writer.tensor(&tensor.name, &bytes).unwrap();
        }
        writer.finish().unwrap();
    }

    /// Writes `to` as `from` with another number of future tokens.
    fn resize(&self, from: &str, to: &str, count: usize) -> ResizeReport {
        let options = ResizeOptions::new(RewriteOptions::default(), count);
        resize(&self.0.join(from), &self.0.join(to), &options, |_, _| true).unwrap()
    }

    fn text(&self, name: &str, file: &str) -> String {
        std::fs::read_to_string(self.0.join(name).join(file)).unwrap()
    }
}

impl Drop for Directory {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

#[test]
fn all_of_a_config_but_the_number_stays_as_it_is_written() {
    assert_eq!(
        resized_config(CONFIG, 9).unwrap(),
        CONFIG.replace("num_target_vision_tokens\": 4", "num_target_vision_tokens\": 9")
    );
}

#[test]
fn a_bias_comes_and_goes() {
    let directory = Directory::new();
    directory.write("four", CONFIG, CONFIG, "");
    for (from, to, count) in [("four", "two", 2), ("two", "one", 1), ("one", "back", 4)] {
        let report = directory.resize(from, to, count);
        let config = HeadConfig::from_json(&directory.text(to, "config.json")).unwrap();
        assert_eq!(config.num_future_tokens, count);
        assert_eq!(config.future_key_bias, report.future_key_bias);
        assert_eq!(config.future_key_bias.is_some(), count < 4, "{to}");
    }
    assert_eq!(directory.text("back", "config.json"), CONFIG);
}

#[test]
fn a_bias_goes_wherever_its_key_is() {
    for written in [
        CONFIG.replace(
            "\"use_vlln\": false,",
            "\"saccade\" :\t{\"future_key_bias\": null} , \"use_vlln\": false,",
        ),
        CONFIG.replace(
            "\"interleave_self_attention\": true}",
            "\"interleave_self_attention\": true}\n, \"saccade\": {}",
        ),
    ] {
        let back: Value = serde_json::from_str(&resized_config(&written, 4).unwrap()).unwrap();
        assert_eq!(back, serde_json::from_str::<Value>(CONFIG).unwrap());
    }
}

#[test]
fn a_number_that_the_config_leaves_out_is_written() {
    let given = CONFIG.replace("\"num_target_vision_tokens\": 4, ", "");
    assert_eq!(HeadConfig::from_json(&given).unwrap().num_future_tokens, 32);
    let given = given.replace("{\"num_target_vision_tokens\": 4}", "");
    let text = resized_config(&given, 40).unwrap();
    assert_eq!(HeadConfig::from_json(&text).unwrap().num_future_tokens, 40);
}

#[test]
fn numbers_that_disagree_are_all_listed() {
    let given = CONFIG.replace(
        "[{\"num_target_vision_tokens\": 4}]",
        "[{\"num_target_vision_tokens\": 32}]",
    );
    let error = resized_config(&given, 9).unwrap_err().to_string();
    assert!(
        error.contains("extra[0].num_target_vision_tokens is 32"),
        "{error}"
    );
    assert!(error.contains("4 future tokens"), "{error}");
}

#[test]
fn a_config_without_a_head_is_left_alone() {
    let sizes = json!({
        "model_type": "gr00t_n1_5", "action_dim": 3, "action_horizon": 16, "add_pos_embed": true,
        "backbone_embedding_dim": 64, "hidden_size": 7, "input_embedding_dim": 48, "max_state_dim": 6,
        "num_inference_timesteps": 4, "num_target_vision_tokens": 4, "use_vlln": false,
        "diffusion_model_cfg": {
            "num_layers": 2, "num_attention_heads": 1, "attention_head_dim": 48, "positional_embeddings": null,
            "cross_attention_dim": 64, "interleave_self_attention": true
        }
    });
    let given = "{\"type\": \"groot\", \"chunk_size\": 50}";
    let directory = Directory::new();
    directory.write("four", &sizes.to_string(), given, "_groot_model.action_head.");
    for (from, to, count) in [("four", "two", 2), ("two", "back", 4)] {
        let report = directory.resize(from, to, count);
        assert_eq!(directory.text(to, "config.json"), given);
        let own = directory.0.join(to).join("saccade.json");
        assert_eq!(own.exists(), count < 4, "{to}");
        if own.exists() {
            let own: Value = serde_json::from_str(&directory.text(to, "saccade.json")).unwrap();
            assert_eq!(own, json!({"future_key_bias": report.future_key_bias}));
        }
    }
}

proptest::proptest! {
    #[test]
    fn a_constant_added_to_all_biases_stays_a_constant(
        before in 2usize..9,
        tokens in proptest::collection::vec(-0.5f32..0.5, 27),
        // Multiples of 2^-13 up to 2^10 are exact in float32.
        bias in proptest::collection::vec(0u16..8192, 9),
        shift in -1000i16..1000,
    ) {
        let tokens = &tokens[..before * 3];
        let bias: Vec<f32> = bias[..before].iter().map(|&bias| f32::from(bias) / 8192.0).collect();
        let moved: Vec<f32> = bias.iter().map(|bias| bias + f32::from(shift)).collect();
        let [one, other] =
            [&bias, &moved].map(|bias| merge_future_tokens(tokens, 3, 1, Some(bias)).unwrap());
        for (one, other) in one.tokens.iter().zip(&other.tokens) {
            proptest::prop_assert!((one - other).abs() < 1e-4, "{} {}", one, other);
        }
        let of = |merged: &MergedTokens| f64::from(merged.key_bias.as_ref().map_or(0.0, |bias| bias[0]));
        let difference = of(&other) - of(&one);
        proptest::prop_assert!((difference - f64::from(shift)).abs() < 1e-3, "{} {}", difference, shift);
    }
}

#[test]
fn large_biases_neither_overflow_nor_vanish() {
    let tokens = [1.0, 0.0, 0.0, 1.0];
    let merged = |bias: &[f32]| merge_future_tokens(&tokens, 2, 1, Some(bias)).unwrap();
    let two = merged(&[800.0, 800.0]);
    assert_eq!(two.tokens, [0.5, 0.5]);
    assert_eq!(two.key_bias, Some(vec![(800.0 + 2.0f64.ln()) as f32]));
    let none = merged(&[-1000.0, -1000.0]);
    assert_eq!(none.key_bias, Some(vec![(-1000.0 + 2.0f64.ln()) as f32]));
    let one = merged(&[-1000.0, 0.0]);
    assert_eq!((one.tokens, one.key_bias), (vec![0.0, 1.0], None));
}

#[test]
fn arguments_are_checked() {
    for (tokens, width, count, bias) in [
        (vec![0.0; 5], 2, 1, None),
        (vec![0.0; 4], 0, 1, None),
        (vec![0.0; 4], 2, 3, None),
        (vec![0.0; 4], 2, 1, Some(vec![0.0; 3])),
        (vec![f32::NAN; 4], 2, 1, None),
        (vec![0.0; 4], 2, 1, Some(vec![f32::INFINITY; 2])),
    ] {
        assert!(merge_future_tokens(&tokens, width, count, bias.as_deref()).is_err());
    }
    assert_eq!(
        merge_future_tokens(&[], 2, 0, None).unwrap().sources,
        Vec::<Vec<usize>>::new()
    );
}

#[test]
fn tokens_that_a_layer_norm_cannot_bear_are_refused() {
    let directory = Directory::new();
    directory.write("four", CONFIG, CONFIG, "");
    let grown = |amount: f64| {
        let options = ResizeOptions {
            perturbation: amount,
            ..ResizeOptions::new(RewriteOptions::default(), 8)
        };
        let out = directory.0.join(format!("by {amount}"));
        let report = resize(&directory.0.join("four"), &out, &options, |_, _| true)?;
        let tokens = Checkpoint::open(&out)?.read_f32("future_tokens.weight")?;
        Ok::<_, Error>((report.perturbation_rms, tokens))
    };
    let (_, plain) = grown(0.0).unwrap();
    let (rms, tokens) = grown(0.25).unwrap();
    let size = plain.iter().map(|value| value.powi(2)).sum::<f32>() / plain.len() as f32;
    assert!((0.05..0.5).contains(&(rms / f64::from(size.sqrt()))), "{rms}");
    assert_eq!(tokens[..4 * WIDTH], plain[..4 * WIDTH]);
    for amount in [-1.0, f64::NAN, f64::INFINITY, 1e38, 1e300, 1e21] {
        assert!(grown(amount).is_err(), "{amount}");
    }
    // What is let through is far from overflowing: the squares of a row's distances from its mean can be summed.
    for row in grown(2e18).unwrap().1.as_chunks::<WIDTH>().0 {
        let mean = row.iter().sum::<f32>() / row.len() as f32;
        let squares: f32 = row.iter().map(|value| (value - mean).powi(2)).sum();
        assert!(squares.is_finite());
    }
}
