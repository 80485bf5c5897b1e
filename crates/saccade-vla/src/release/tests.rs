//! A release that nobody has made: its row and its line in the table are all that it needs to be recognised,
//! loaded, prepared, encoded and sampled.

use std::path::{Path, PathBuf};

use serde_json::json;

use super::version::Version;
use crate::array::{Array, ArrayMut};
use crate::backbone::{Backbone, BackboneLoadOptions, published_specs};
use crate::config::HeadConfig;
use crate::head::action_head::ActionHead;
use crate::head::load::LoadOptions;
use crate::head::plan::tensor_shapes;
use crate::head::sample::Sampling;
use crate::policy::Policy;
use crate::processor::{Frame, Observation, ProcessorSource};
use crate::recognise::HeadCheckpoint;

const CONFIG: &str = r#"{
    "model_type": "Gr00tN1d9", "model_name": "made up", "hidden_size": 10, "max_num_embodiments": 2,
    "diffusion_model_cfg": {
        "attention_head_dim": 4, "interleave_self_attention": true, "norm_type": "ada_norm", "num_attention_heads": 2,
        "num_layers": 4, "output_dim": 10, "positional_embeddings": null
    }
}"#;

/// The directory of a checkpoint, removed at the end.
struct Directory(PathBuf);

impl Drop for Directory {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// A checkpoint of the release in NVIDIA's layout: small weights, the config, a tokenizer.
fn checkpoint(version: Version) -> Directory {
    let directory = std::env::temp_dir().join(format!("saccade-{}-{}", version.name(), std::process::id()));
    std::fs::create_dir_all(&directory).unwrap();
    let config = HeadConfig::from_json(CONFIG).unwrap();
    let head = tensor_shapes(&config).unwrap().into_iter();
    let head = head.map(|(name, shape)| (format!("action_head.{name}"), shape));
    let backbone = published_specs(version).unwrap().into_iter();
    let backbone = backbone.map(|tensor| (format!("backbone.{}", tensor.name), tensor.shape));
    let (mut header, mut data) = (serde_json::Map::new(), Vec::new());
    for (name, shape) in head.chain(backbone) {
        let start = data.len();
        for index in 0..shape.iter().product() {
            let value = (index * 37 % 101) as f32 / 500.0 - 0.1;
            data.extend_from_slice(&value.to_le_bytes());
        }
        let tensor = json!({"dtype": "F32", "shape": shape, "data_offsets": [start, data.len()]});
        header.insert(name, tensor);
    }
    let header = json!(header).to_string();
    let size = (header.len() as u64).to_le_bytes();
    let file = [&size[..], header.as_bytes(), &data].concat();
    std::fs::write(directory.join("model.safetensors"), file).unwrap();
    std::fs::write(directory.join("config.json"), CONFIG).unwrap();
    let tokenizer =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/backbone/tiny_tokenizer.json");
    std::fs::copy(tokenizer, directory.join("tokenizer.json")).unwrap();
    Directory(directory)
}

#[test]
fn a_made_up_release_needs_its_row_only() {
    let version: Version = "n1.9".parse().unwrap();
    let directory = checkpoint(version);
    let path = &directory.0;
    let opened = HeadCheckpoint::open(path, None).unwrap();
    assert_eq!((opened.config.version, opened.layout), (version, "nvidia"));
    assert_eq!(opened.config.num_future_tokens, 3);
    opened.check().unwrap();

    let source = ProcessorSource::open(path).unwrap();
    assert_eq!(
        (source.version(), source.published()),
        (version, &["nobody/n1d9"][..])
    );
    let processor = source.processor(None, None, None).unwrap();
    let pixels: Vec<u8> = (0..40 * 24 * 3).map(|index| (index % 251) as u8).collect();
    let frame = Frame::U8(Array::new(&pixels, &[40, 24, 3]).unwrap());
    let observations = [Observation {
        views: vec![(Some("front"), frame)],
        instruction: Some("Lift the CUP."),
        ..Observation::default()
    }];
    let prepared = processor.process(&observations).unwrap();
    // 20 x 12 pixels have the greatest area; 16 x 8 are whole tokens.
    let pixels = &prepared.pixel_values[0];
    assert_eq!(pixels.shape(), [1, 3, 16, 8]);
    let prompt = processor.texts(prepared.input_ids.data()).unwrap().concat();
    assert_eq!(
        prompt,
        "<|im_start|>do lift the cup with<image 1><|box_start|><|fim_pad|><|fim_pad|><|box_end|><|im_end|>"
    );

    let backbone = Backbone::load(path, &BackboneLoadOptions::default()).unwrap();
    assert_eq!(backbone.config().version, version);
    let head = ActionHead::load(path, &LoadOptions::default()).unwrap();
    let policy = Policy::new(processor, backbone, head);
    let context = policy.encode(&observations, None).unwrap();
    assert_eq!(context.num_vl_tokens(), prepared.input_ids.shape()[1]);
    let mut actions = [f32::NAN; 24];
    let sampled = policy.sample(
        &context,
        Array::new(&[0.5; 5], &[1, 5]).unwrap(),
        Array::new(&[1], &[1]).unwrap(),
        Array::new(&[0.25; 24], &[1, 4, 6]).unwrap(),
        &Sampling::default(),
        ArrayMut::new(&mut actions, &[1, 4, 6]).unwrap(),
    );
    sampled.unwrap();
    assert!(actions.iter().all(|action| action.is_finite() && *action != 0.25));
}

#[test]
fn an_unknown_release_is_refused_by_name() {
    let error = "n2".parse::<Version>().unwrap_err().to_string();
    assert!(
        error.starts_with("version: expected \"n1\", \"n1.5\", \"n1.6\", \"n1.7\""),
        "{error}"
    );
    assert!(error.ends_with("got \"n2\""), "{error}");
}
