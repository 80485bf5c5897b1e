//! The whole head at N1.5's size with random weights: `encode`, `sample`, and the cost of more samples from one context.
//!
//! Writes 1.5 GB of bfloat16 weights to the temporary directory and removes them as soon as they are loaded.

use std::fs::File;
use std::hint::black_box;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use half::bf16;
use saccade_benches::measure::{Contender, measure};
use saccade_benches::options::Options;
use saccade_benches::random::Random;
use saccade_benches::report::Report;
use saccade_vla::{ActionHead, Array, ArrayMut, Features, LoadOptions, Sampling};
use serde_json::{Map, Value, json};

const NUM_VL_TOKENS: usize = 296;
const CHUNK: usize = 16 * 32; // action_horizon x action_dim

/// The work of one call, so that rates are calls a second.
const CALL: f64 = 1e9;

/// GR00T N1.5's sizes, with one embodiment.
fn config() -> Value {
    json!({
        "action_dim": 32, "action_horizon": 16, "add_pos_embed": true, "backbone_embedding_dim": 2048,
        "hidden_size": 1024, "input_embedding_dim": 1536, "max_state_dim": 64, "max_num_embodiments": 1,
        "num_inference_timesteps": 4, "num_target_vision_tokens": 32, "num_timestep_buckets": 1000, "use_vlln": true,
        "diffusion_model_cfg": {
            "num_layers": 16, "num_attention_heads": 32, "attention_head_dim": 48, "interleave_self_attention": true
        },
        "vl_self_attention_cfg": {"num_layers": 4, "num_attention_heads": 32, "attention_head_dim": 64}
    })
}

/// The released tensors' names and shapes: the list that the tests hold, cut to one embodiment.
fn tensors() -> Vec<(String, Vec<usize>)> {
    let list = include_str!("../tests/data/groot_n15_tensors.tsv");
    let lines = list.lines().filter(|line| line.starts_with("action_head."));
    lines
        .map(|line| {
            let mut cells = line.split('\t');
            let name = cells.next().expect("a name").to_owned();
            let shape = cells
                .next()
                .expect("a shape")
                .split('x')
                .map(|size| size.parse().expect("a size"));
            let mut shape: Vec<usize> = shape.collect();
            if name.ends_with(".W") || name.ends_with(".b") {
                shape[0] = 1;
            }
            (name, shape)
        })
        .collect()
}

fn write_checkpoint(path: &Path) -> std::io::Result<()> {
    let (mut header, mut end) = (Map::new(), 0);
    let tensors = tensors();
    for (name, shape) in &tensors {
        let begin = end;
        end += 2 * shape.iter().product::<usize>();
        header.insert(
            name.clone(),
            json!({"dtype": "BF16", "shape": shape, "data_offsets": [begin, end]}),
        );
    }
    let header = Value::Object(header).to_string();
    let mut file = BufWriter::new(File::create(path)?);
    file.write_all(&(header.len() as u64).to_le_bytes())?;
    file.write_all(header.as_bytes())?;
    let mut random = Random::new(0);
    for _ in 0..end / 2 {
        file.write_all(&bf16::from_f32(random.uniform(0.04)).to_le_bytes())?;
    }
    file.flush()
}

fn load() -> ActionHead {
    let path: PathBuf =
        std::env::temp_dir().join(format!("saccade-bench-{}.safetensors", std::process::id()));
    write_checkpoint(&path).expect("1.5 GB of room for temporary files");
    let options = LoadOptions {
        config: Some(config().to_string()),
        ..LoadOptions::default()
    };
    let head = ActionHead::load(&path, &options);
    std::fs::remove_file(&path).expect("the file was just written");
    head.expect("the checkpoint that was just written")
}

fn main() {
    let options = Options::from_args();
    let head = load();
    let mut report = Report::begin("head", "calls", &options);
    let mut random = Random::new(1);
    let mut numbers = |len: usize| random.vec(len, 1.0);
    let (features, state, noise) = (numbers(NUM_VL_TOKENS * 2048), numbers(64), numbers(8 * CHUNK));
    let features = Array::new(&features, &[1, NUM_VL_TOKENS, 2048]).expect("a shape that fits");
    let features = Features::new(features);
    let context = head.encode(&features).expect("features that fit");
    let mut contenders = vec![Contender::new("encode", CALL, || {
        black_box(head.encode(&features).expect("features that fit"));
    })];
    for samples in [1, 8] {
        let (head, context, state, noise) = (&head, &context, &state, &noise);
        let mut out = vec![0.0; samples * CHUNK];
        let mut sample = move || {
            head.sample(
                context,
                Array::new(state, &[1, 64])?,
                Array::new(&[0], &[])?,
                Array::new(&noise[..samples * CHUNK], &[1, samples, 16, 32])?,
                &Sampling {
                    num_samples: Some(samples),
                    ..Sampling::default()
                },
                ArrayMut::new(&mut out, &[1, samples, 16, 32])?,
            )
        };
        contenders.push(Contender::new(format!("sample {samples}"), CALL, move || {
            sample().expect("inputs that fit");
        }));
    }
    for contender in &mut contenders {
        contender.threads = head.engine().threads;
    }
    let name = format!("N1.5, {}", head.engine().isa);
    report.case(&name, &measure(&options, &mut contenders));
    report.end(&options);
}
