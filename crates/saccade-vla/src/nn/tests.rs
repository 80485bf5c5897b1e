//! Layers against plain loops in float64, and those of released models against the code that they were
//! released with.

use std::collections::BTreeMap;
use std::path::Path;

use saccade_vla_checkpoint::Checkpoint;
use saccade_vla_kernels::{Epilogue, Isa, LinearScratch, Rows, RowsMut};

use super::feed_forward::{DIFFUSERS, FeedForward};
use super::grouped_attention::{
    Attended, Causal, GroupedAttention, GroupedSizes, GroupedWorkspace, Projections, Qkv,
};
use super::kv_cache;
use super::linear::Linear;
use super::norm::RmsNorm;
use super::rope::{Rope, one_axis};
use super::source::memory::{ElementsRef, MemorySource, TensorView, TensorViews};
use super::weights::{Builder, Weights};
use crate::alloc::Scratch;
use crate::engine::{Engine, Kernels};
use crate::error::Result;
use crate::precision::{Precision, Role};

/// Numbers that look random and are the same everywhere, below 1 in size.
fn numbers(len: usize, seed: u32) -> Vec<f32> {
    let mut state = seed.wrapping_mul(2_654_435_761).wrapping_add(12345);
    let mut next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 23) as f32 - 1.0
    };
    (0..len).map(|_| next()).collect()
}

/// Tensors by name and shape.
struct Named(BTreeMap<String, (Vec<usize>, Vec<f32>)>);

impl Named {
    fn new(shapes: &[(&str, &[usize])]) -> Self {
        let tensor = |(index, (name, shape)): (usize, &(&str, &[usize]))| {
            let mut values = numbers(shape.iter().product(), index as u32 + 1);
            values.iter_mut().for_each(|value| *value *= 0.3);
            ((*name).to_owned(), (shape.to_vec(), values))
        };
        Self(shapes.iter().enumerate().map(tensor).collect())
    }

    /// The layer that `build` makes of them, on each instruction set.
    fn layers<L>(&self, build: impl Fn(&Weights<'_>) -> Result<L>) -> Vec<(Engine, L)> {
        let mut views = TensorViews::new();
        for (name, (shape, values)) in &self.0 {
            let view = TensorView::new(shape, ElementsRef::F32(values)).unwrap();
            views.insert(name.clone(), view);
        }
        let source = MemorySource::new(&views);
        let engine = |isa| Engine {
            isa,
            threads: 2,
            precision: Precision::Float32,
        };
        Isa::available()
            .into_iter()
            .map(|isa| {
                let builder = Builder::new(&source, engine(isa));
                (engine(isa), build(&builder.weights()).unwrap())
            })
            .collect()
    }

    fn get(&self, name: &str) -> Vec<f64> {
        self.0[name].1.iter().copied().map(f64::from).collect()
    }

    /// `x W^T + b`, without `b` if there is none.
    fn linear(&self, name: &str, x: &[f64], in_features: usize) -> Vec<f64> {
        let weight = self.get(&format!("{name}.weight"));
        let bias = format!("{name}.bias");
        let bias = self.0.contains_key(&bias).then(|| self.get(&bias));
        let outputs = weight.len() / in_features;
        let mut out = Vec::new();
        for x in x.chunks(in_features) {
            for output in 0..outputs {
                let row = &weight[output * in_features..][..in_features];
                let sum: f64 = row.iter().zip(x).map(|(w, x)| w * x).sum();
                out.push(sum + bias.as_ref().map_or(0.0, |bias| bias[output]));
            }
        }
        out
    }
}

fn widened(values: &[f32]) -> Vec<f64> {
    values.iter().copied().map(f64::from).collect()
}

fn rms_norm(x: &mut [f64], weight: &[f64], eps: f64) {
    for head in x.chunks_mut(weight.len()) {
        let mean = head.iter().map(|x| x * x).sum::<f64>() / head.len() as f64;
        let norm = (mean + eps).sqrt();
        head.iter_mut().zip(weight).for_each(|(x, w)| *x = *x / norm * w);
    }
}

fn rotate(x: &mut [f64], head_dim: usize, base: f64, position: usize) {
    let pairs = head_dim / 2;
    for head in x.chunks_mut(head_dim) {
        for pair in 0..pairs {
            let angle = position as f64 * base.powf(-(pair as f64) / pairs as f64);
            let (a, b) = (head[pair], head[pairs + pair]);
            head[pair] = a * angle.cos() - b * angle.sin();
            head[pairs + pair] = b * angle.cos() + a * angle.sin();
        }
    }
}

fn assert_close(given: &[f32], expected: &[f64], what: &str) {
    assert_eq!(given.len(), expected.len(), "{what}");
    for (index, (given, expected)) in given.iter().zip(expected).enumerate() {
        let error = (f64::from(*given) - expected).abs();
        assert!(
            error <= 5e-6 * expected.abs().max(1.0),
            "{what}, {index}: {given}, {expected}"
        );
    }
}

#[test]
fn linear_layers_without_a_bias() {
    let named = Named::new(&[("a.weight", &[5, 7]), ("b.weight", &[3, 7])]);
    let x = numbers(4 * 7, 9);
    let (a, b) = (
        named.linear("a", &widened(&x), 7),
        named.linear("b", &widened(&x), 7),
    );
    let expected: Vec<f64> = a
        .chunks(5)
        .zip(b.chunks(3))
        .flat_map(|(a, b)| [a, b].concat())
        .collect();
    let stacked = |weights: &Weights<'_>| {
        Linear::stacked(
            &[(weights.at("a"), 5), (weights.at("b"), 3)],
            7,
            Role::Block,
            false,
        )
    };
    for (engine, layer) in named.layers(stacked) {
        let mut out = vec![0.0; 4 * 8];
        let mut scratch = LinearScratch::new();
        let kernels = &mut Kernels::new(engine, &mut scratch);
        let rows = RowsMut::new(&mut out, 8);
        layer
            .apply(kernels, Rows::new(&x, 7), Epilogue::Store, rows)
            .unwrap();
        assert_close(&out, &expected, &engine.isa.to_string());
    }
}

/// Checks that `add(engine, layer, y, x)` gives `expected` for `y` and `x (rows, width)`, on each instruction
/// set.
fn assert_adds<L>(
    layers: Vec<(Engine, L)>,
    (y, x, width): (&[f32], &[f32], usize),
    expected: &[f64],
    what: &str,
    add: impl Fn(&mut Kernels<'_>, &L, Rows<'_>, RowsMut<'_>) -> Result<()>,
) {
    for (engine, layer) in layers {
        let mut out = x.to_vec();
        let mut scratch = LinearScratch::new();
        let kernels = &mut Kernels::new(engine, &mut scratch);
        let rows = RowsMut::new(&mut out, width);
        add(kernels, &layer, Rows::new(y, width), rows).unwrap();
        assert_close(&out, expected, &format!("{what} {}", engine.isa));
    }
}

/// `layer.add` with memory of its own.
fn add_feed_forward(
    kernels: &mut Kernels<'_>,
    layer: &FeedForward,
    y: Rows<'_>,
    x: RowsMut<'_>,
) -> Result<()> {
    layer.add(kernels, y, &mut Scratch::default(), x)
}

#[test]
fn feed_forwards_of_any_hidden_width_and_activation() {
    let named = Named::new(&[
        ("net.0.proj.weight", &[11, 6]),
        ("net.0.proj.bias", &[11]),
        ("net.2.weight", &[6, 11]),
        ("net.2.bias", &[6]),
    ]);
    let (y, x) = (numbers(3 * 6, 1), numbers(3 * 6, 2));
    for (activation, function) in [
        (Epilogue::Relu, (|x: f64| x.max(0.0)) as fn(f64) -> f64),
        (Epilogue::Silu, |x| x / (1.0 + (-x).exp())),
        (Epilogue::GeluTanh, |x| {
            0.5 * x * (1.0 + ((2.0 / std::f64::consts::PI).sqrt() * (x + 0.044715 * x.powi(3))).tanh())
        }),
    ] {
        let mut hidden = named.linear("net.0.proj", &widened(&y), 6);
        hidden.iter_mut().for_each(|value| *value = function(*value));
        let mut expected = named.linear("net.2", &hidden, 11);
        expected
            .iter_mut()
            .zip(&x)
            .for_each(|(sum, x)| *sum += f64::from(*x));
        let build =
            |weights: &Weights<'_>| FeedForward::new(weights, DIFFUSERS, [6, 11], activation, Role::Block);
        let what = format!("{activation:?}");
        assert_adds(
            named.layers(build),
            (&y, &x, 6),
            &expected,
            &what,
            add_feed_forward,
        );
    }
}

/// Qwen's names, with the biases of its second version.
const QWEN_WITH_BIAS: Projections = Projections {
    qkv: Qkv::Separate(["q_proj", "k_proj", "v_proj"]),
    out: "o_proj",
    qkv_bias: true,
    out_bias: false,
};

/// Softmax over the keys that each row sees, in float64.
fn attention(sizes: GroupedSizes, qkv: &[f64], bias: impl Fn(usize, usize) -> f64) -> Vec<f64> {
    let GroupedSizes {
        num_heads,
        num_kv_heads,
        head_dim,
        ..
    } = sizes;
    let (queries, keys) = (num_heads * head_dim, num_kv_heads * head_dim);
    let all = queries + 2 * keys;
    let count = qkv.len() / all;
    let mut mix = vec![0.0; count * queries];
    for row in 0..count {
        for head in 0..num_heads {
            let of_kv = head / (num_heads / num_kv_heads) * head_dim;
            let q = &qkv[row * all + head * head_dim..][..head_dim];
            let logit = |key: usize| {
                let k = &qkv[key * all + queries + of_kv..][..head_dim];
                let dot: f64 = q.iter().zip(k).map(|(q, k)| q * k).sum();
                dot / (head_dim as f64).sqrt() + bias(row, key)
            };
            let weights: Vec<f64> = (0..count).map(|key| logit(key).exp()).collect();
            let total: f64 = weights.iter().sum();
            for (key, weight) in weights.iter().enumerate() {
                let v = &qkv[key * all + queries + keys + of_kv..][..head_dim];
                let out = &mut mix[row * queries + head * head_dim..][..head_dim];
                let weight = if total > 0.0 { weight / total } else { 0.0 };
                out.iter_mut().zip(v).for_each(|(out, v)| *out += weight * v);
            }
        }
    }
    mix
}

#[test]
fn grouped_attention_with_norms_rotation_and_masks() {
    let sizes = GroupedSizes {
        width: 10,
        num_heads: 6,
        num_kv_heads: 2,
        head_dim: 4,
    };
    let named = Named::new(&[
        ("q_proj.weight", &[24, 10]),
        ("q_proj.bias", &[24]),
        ("k_proj.weight", &[8, 10]),
        ("k_proj.bias", &[8]),
        ("v_proj.weight", &[8, 10]),
        ("v_proj.bias", &[8]),
        ("o_proj.weight", &[10, 24]),
        ("q_norm.weight", &[4]),
        ("k_norm.weight", &[4]),
    ]);
    let (count, base) = (37, 10_000.0);
    let positions: Vec<[usize; 1]> = (0..count).map(|row| [3 + row]).collect();
    let (y, x) = (numbers(count * 10, 4), numbers(count * 10, 5));
    let attended: Vec<bool> = (0..count)
        .map(|row| ![0, 1, 5, 6, 20, 36].contains(&row))
        .collect();
    let rope = Rope::new(4, &one_axis(base, 4), &positions).unwrap();
    for (has_norms, is_rotated, is_causal) in [(true, true, true), (false, true, false), (true, false, true)]
    {
        let [mut q, mut k, v] =
            ["q_proj", "k_proj", "v_proj"].map(|name| named.linear(name, &widened(&y), 10));
        if has_norms {
            rms_norm(&mut q, &named.get("q_norm.weight"), 1e-6);
            rms_norm(&mut k, &named.get("k_norm.weight"), 1e-6);
        }
        if is_rotated {
            for (row, [position]) in positions.iter().enumerate() {
                rotate(&mut q[row * 24..][..24], 4, base, *position);
                rotate(&mut k[row * 8..][..8], 4, base, *position);
            }
        }
        let row = |row: usize| [&q[row * 24..][..24], &k[row * 8..][..8], &v[row * 8..][..8]].concat();
        let qkv: Vec<f64> = (0..count).flat_map(row).collect();
        let mix = attention(sizes, &qkv, |row, key| match is_causal {
            true if key > row || !attended[key] => f64::NEG_INFINITY,
            _ => 0.0,
        });
        let mut expected = named.linear("o_proj", &mix, 24);
        expected
            .iter_mut()
            .zip(&x)
            .for_each(|(sum, x)| *sum += f64::from(*x));
        let eps = has_norms.then_some(1e-6);
        let layers = named.layers(|weights| GroupedAttention::new(weights, sizes, QWEN_WITH_BIAS, eps));
        let what = format!("{has_norms} {is_rotated}");
        let rope = is_rotated.then_some(&rope);
        assert_adds(layers, (&y, &x, 10), &expected, &what, |kernels, layer, y, x| {
            let causal = &mut [Causal {
                cache: &mut kv_cache::empty(kernels.engine, 2, 4),
                attended: &attended,
            }];
            let sequences = match is_causal {
                true => Attended::Causal(causal),
                false => Attended::Whole(&[count]),
            };
            layer.add(kernels, y, rope, sequences, &mut GroupedWorkspace::default(), x)
        });
    }
}

/// A layer of a released model as transformers has it: its tensors, an `input`, and its `output` in float64.
fn released(name: &str) -> Named {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/backbone_layers.safetensors");
    let checkpoint = Checkpoint::open(&path).unwrap();
    let prefix = format!("{name}.");
    let tensors = checkpoint.names().filter_map(|full| {
        let name = full.strip_prefix(&prefix)?.to_owned();
        let shape = checkpoint.shape(full)?.to_vec();
        Some((name, (shape, checkpoint.read_f32(full).unwrap())))
    });
    Named(tensors.collect())
}

/// Checks `add`, which adds the result for rows of `width` to `x`, on each instruction set.
fn assert_released<L>(
    name: &str,
    width: usize,
    build: impl Fn(&Weights<'_>) -> Result<L>,
    add: impl Fn(&mut Kernels<'_>, &L, Rows<'_>, RowsMut<'_>) -> Result<()>,
) {
    let named = released(name);
    let (input, expected) = (&named.0["input"].1, named.get("output"));
    let zeros = vec![0.0; expected.len()];
    assert_adds(named.layers(build), (input, &zeros, width), &expected, name, add);
}

#[test]
fn the_layers_of_qwen_are_those_of_transformers() {
    let sizes = GroupedSizes {
        width: 20,
        num_heads: 6,
        num_kv_heads: 2,
        head_dim: 8,
    };
    let projections = Projections {
        qkv_bias: false,
        ..QWEN_WITH_BIAS
    };
    let positions: Vec<[usize; 1]> = (5..16).map(|position| [position]).collect();
    let rope = Rope::new(8, &one_axis(1e6, 8), &positions).unwrap();
    assert_released(
        "qwen3.self_attn",
        20,
        |weights| GroupedAttention::new(weights, sizes, projections, Some(1e-6)),
        |kernels, layer, y, x| {
            let causal = &mut [Causal {
                cache: &mut kv_cache::empty(kernels.engine, 2, 8),
                attended: &[true; 11],
            }];
            let (sequences, workspace) = (Attended::Causal(causal), &mut GroupedWorkspace::default());
            layer.add(kernels, y, Some(&rope), sequences, workspace, x)
        },
    );
    assert_released(
        "qwen3.mlp",
        20,
        |weights| FeedForward::gated(weights, [20, 28], Epilogue::Silu),
        add_feed_forward,
    );
    assert_released(
        "qwen3.norm",
        20,
        |weights| RmsNorm::new(weights, 20, 1e-6),
        |kernels, layer, y, x| layer.apply(kernels.engine, y, x),
    );
}

#[test]
fn the_layers_of_siglip_are_those_of_transformers() {
    let sizes = GroupedSizes {
        width: 24,
        num_heads: 3,
        num_kv_heads: 3,
        head_dim: 8,
    };
    let projections = Projections {
        qkv: QWEN_WITH_BIAS.qkv,
        out: "out_proj",
        qkv_bias: true,
        out_bias: true,
    };
    assert_released(
        "siglip.self_attn",
        24,
        |weights| GroupedAttention::new(weights, sizes, projections, None),
        |kernels, layer, y, x| {
            let workspace = &mut GroupedWorkspace::default();
            layer.add(kernels, y, None, Attended::Whole(&[11]), workspace, x)
        },
    );
    assert_released(
        "siglip.mlp",
        24,
        |weights| FeedForward::new(weights, ["fc1", "fc2"], [24, 36], Epilogue::GeluTanh, Role::Block),
        add_feed_forward,
    );
}
