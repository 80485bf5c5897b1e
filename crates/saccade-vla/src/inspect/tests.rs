//! What interventions mean, where they act, and what is refused.

use saccade_vla_kernels::{LogitBias, RowsMut};

use super::changes::Changes;
use super::extent::Extent;
use super::groups::{Group, Tokens};
use super::intervention::{Intervention, Patch};
use crate::array::OwnedArray;
use crate::config::HeadConfig;
use crate::error::Result;

/// Four blocks, two heads, three future and two action rows, width 4.
fn config() -> HeadConfig {
    HeadConfig::from_json(
        r#"{
            "action_dim": 3, "action_horizon": 2, "add_pos_embed": true, "backbone_embedding_dim": 6, "hidden_size": 5,
            "input_embedding_dim": 4, "max_action_dim": 3, "max_num_embodiments": 2, "max_seq_len": 4, "max_state_dim": 7,
            "num_inference_timesteps": 4, "num_target_vision_tokens": 3, "num_timestep_buckets": 1000, "use_vlln": true,
            "diffusion_model_cfg": {
                "attention_head_dim": 2, "cross_attention_dim": 6, "interleave_self_attention": true, "norm_type": "ada_norm",
                "num_attention_heads": 2, "num_layers": 4, "output_dim": 5, "positional_embeddings": null
            },
            "vl_self_attention_cfg": {
                "attention_head_dim": 3, "num_attention_heads": 2, "num_layers": 1, "positional_embeddings": null
            }
        }"#,
    )
    .unwrap()
}

const LEARNED: [f32; 12] = [0.5; 12];
const CUT: f32 = f32::NEG_INFINITY;

/// What the interventions mean for two observations of five tokens and three steps.
fn changes<'a>(config: &'a HeadConfig, interventions: &'a [Intervention]) -> Result<Changes<'a>> {
    let extent = Extent::new(config, &LEARNED, interventions, [2, 5], 3)?;
    Changes::new(interventions, extent)
}

fn message(intervention: Intervention) -> String {
    changes(&config(), &[intervention])
        .err()
        .expect("an error")
        .to_string()
}

fn all(group: Group) -> Tokens {
    Tokens { group, indices: None }
}

fn some(group: Group, indices: &[usize]) -> Tokens {
    Tokens {
        group,
        indices: Some(indices.to_vec()),
    }
}

fn patch(step: usize, block: usize, tokens: Tokens, shape: &[usize]) -> Intervention {
    let values = (0..shape.iter().product()).map(|index: usize| index as f32);
    let rows = OwnedArray::new(values.collect(), shape).unwrap();
    Intervention {
        patch: vec![Patch {
            step,
            block,
            tokens,
            rows,
        }],
        ..Intervention::default()
    }
}

/// The bias of one head and query.
fn row(bias: LogitBias<'_>, head: usize, query: usize, keys: usize) -> Vec<f32> {
    bias.values[head * bias.head_stride + query * bias.query_stride..][..keys].to_vec()
}

#[test]
fn a_cut_is_where_its_keys_are() {
    let config = config();
    let interventions = [Intervention {
        cut: vec![
            (some(Group::Action, &[1]), some(Group::Future, &[2, 0])),
            (all(Group::Future), some(Group::Vl, &[4])),
        ],
        ..Intervention::default()
    }];
    let changes = changes(&config, &interventions).unwrap();
    // Rows: state 0, future 1 to 3, action 4 and 5.
    for step in 0..3 {
        for block in [1, 3] {
            let bias = changes.bias(step, block, 0).unwrap();
            assert_eq!(row(bias, 1, 5, 6), [0.0, CUT, 0.0, CUT, 0.0, 0.0]);
            for query in 0..5 {
                assert_eq!(row(bias, 0, query, 6), [0.0; 6]);
            }
            let of_actions = changes.bias(step, block, 4).unwrap();
            assert_eq!(row(of_actions, 0, 1, 6), row(bias, 0, 5, 6));
        }
        for block in [0, 2] {
            let bias = changes.bias(step, block, 0).unwrap();
            assert_eq!(row(bias, 0, 0, 5), [0.0; 5]);
            assert_eq!(row(bias, 0, 2, 5), [0.0, 0.0, 0.0, 0.0, CUT]);
        }
    }
    assert_eq!(changes.biases.len(), 2, "one for each kind of block");
}

#[test]
fn biases_of_several_add_up_where_they_act_together() {
    let config = config();
    let bias = |tokens, values: &[f32], shape: &[usize]| {
        vec![(tokens, OwnedArray::new(values.to_vec(), shape).unwrap())]
    };
    let interventions = [
        Intervention {
            key_bias: bias(some(Group::Future, &[2, 1]), &[1.0, 2.0], &[2]),
            heads: Some(vec![1]),
            ..Intervention::default()
        },
        Intervention {
            key_bias: bias(all(Group::Future), &[0.25], &[]),
            blocks: Some(vec![3]),
            steps: Some(vec![2, 0]),
            ..Intervention::default()
        },
    ];
    let changes = changes(&config, &interventions).unwrap();
    let alone = changes.bias(1, 3, 0).unwrap();
    assert_eq!(row(alone, 0, 0, 6), [0.0; 6]);
    assert_eq!(row(alone, 1, 0, 6), [0.0, 0.0, 2.0, 1.0, 0.0, 0.0]);
    let both = changes.bias(2, 3, 0).unwrap();
    assert_eq!(row(both, 0, 0, 6), [0.0, 0.25, 0.25, 0.25, 0.0, 0.0]);
    assert_eq!(row(both, 1, 0, 6), [0.0, 0.25, 2.25, 1.25, 0.0, 0.0]);
    assert!(changes.bias(0, 2, 0).is_none(), "none of the keys is read there");
    assert_eq!(changes.biases.len(), 2);
}

#[test]
fn a_head_that_is_listed_twice_gets_its_bias_once() {
    let config = config();
    let interventions = [Intervention {
        key_bias: vec![(all(Group::Future), OwnedArray::new(vec![0.25], &[]).unwrap())],
        heads: Some(vec![1, 1]),
        ..Intervention::default()
    }];
    let changes = changes(&config, &interventions).unwrap();
    let bias = changes.bias(0, 1, 0).unwrap();
    assert_eq!(row(bias, 0, 0, 6), [0.0; 6]);
    assert_eq!(row(bias, 1, 0, 6), [0.0, 0.25, 0.25, 0.25, 0.0, 0.0]);
}

#[test]
fn the_configs_own_bias_is_in_every_self_attention_block_and_under_all_others() {
    let config = HeadConfig {
        future_key_bias: Some(vec![0.5, -1.0, 2.0]),
        ..config()
    };
    let own = [0.0, 0.5, -1.0, 2.0, 0.0, 0.0];
    let plain = changes(&config, &[]).unwrap();
    for (step, block) in [(0, 1), (2, 3)] {
        let bias = plain.bias(step, block, 4).unwrap();
        assert_eq!(
            (row(bias, 0, 0, 6), row(bias, 1, 1, 6)),
            (own.to_vec(), own.to_vec())
        );
    }
    assert!(
        plain.bias(0, 0, 0).is_none(),
        "cross-attention has no future keys"
    );
    assert_eq!(plain.biases.len(), 1);

    let interventions = [Intervention {
        cut: vec![(some(Group::State, &[0]), some(Group::Future, &[1]))],
        key_bias: vec![(all(Group::Future), OwnedArray::new(vec![0.25], &[]).unwrap())],
        steps: Some(vec![1]),
        ..Intervention::default()
    }];
    let both = changes(&config, &interventions).unwrap();
    assert_eq!(row(both.bias(0, 1, 0).unwrap(), 0, 0, 6), own);
    let bias = both.bias(1, 1, 0).unwrap();
    assert_eq!(row(bias, 0, 0, 6), [0.0, 0.75, CUT, 2.25, 0.0, 0.0]);
    assert_eq!(row(bias, 0, 1, 6), [0.0, 0.75, -0.75, 2.25, 0.0, 0.0]);

    let replaced = [Intervention {
        future_tokens: Some(OwnedArray::new(vec![0.0; 8], &[2, 4]).unwrap()),
        ..Intervention::default()
    }];
    let replaced = changes(&config, &replaced).unwrap();
    assert!(replaced.bias(0, 1, 0).is_none(), "it is the learned tokens' own");
}

#[test]
fn what_adds_nothing_is_no_bias() {
    let config = config();
    let empty = [
        Intervention {
            future_tokens: Some(OwnedArray::new(vec![], &[0, 4]).unwrap()),
            ..Intervention::default()
        },
        patch(1, 3, some(Group::State, &[0]), &[1, 4]),
        Intervention {
            blocks: Some(vec![1]),
            ..Intervention::default()
        },
    ];
    let changes = changes(&config, &empty).unwrap();
    assert_eq!(
        (changes.extent.groups.future, changes.extent.groups.num_rows()),
        (0, 3)
    );
    assert!((0..4).all(|block| changes.bias(0, block, 0).is_none()));
}

#[test]
fn patches_replace_rows_of_every_sample() {
    let config = config();
    let interventions = [
        patch(1, 2, some(Group::Action, &[1, 0]), &[2, 2, 4]),
        patch(1, 2, all(Group::State), &[1, 4]),
    ];
    let changes = changes(&config, &interventions).unwrap();
    let samples = 3;
    let mut x = vec![-1.0; 2 * samples * 6 * 4];
    changes.patch(0, 2, 0, samples, RowsMut::new(&mut x, 4));
    changes.patch(1, 3, 0, samples, RowsMut::new(&mut x, 4));
    assert!(x.iter().all(|&value| value == -1.0), "elsewhere");
    changes.patch(1, 2, 0, samples, RowsMut::new(&mut x, 4));
    for (index, sequence) in x.chunks_exact(6 * 4).enumerate() {
        let first = (index / samples * 8) as f32;
        assert_eq!(sequence[..4], [0.0, 1.0, 2.0, 3.0]);
        assert!(sequence[4..16].iter().all(|&value| value == -1.0));
        assert_eq!(sequence[16..20], [4.0, 5.0, 6.0, 7.0].map(|value| first + value));
        assert_eq!(sequence[20..], [0.0, 1.0, 2.0, 3.0].map(|value| first + value));
    }
    let mut actions = vec![-1.0; 2 * samples * 2 * 4];
    changes.patch(1, 2, 4, samples, RowsMut::new(&mut actions, 4));
    for (sequence, actions) in x.chunks_exact(6 * 4).zip(actions.chunks_exact(2 * 4)) {
        assert_eq!(actions, &sequence[16..], "the action rows alone");
    }
}

#[test]
fn messages_name_what_was_given_and_expected() {
    let limited = |blocks: &[usize], steps: &[usize], heads: &[usize]| {
        let list = |indices: &[usize]| (!indices.is_empty()).then(|| indices.to_vec());
        Intervention {
            blocks: list(blocks),
            steps: list(steps),
            heads: list(heads),
            ..Intervention::default()
        }
    };
    let cut = |reader, source| Intervention {
        cut: vec![(reader, source)],
        ..Intervention::default()
    };
    let bias = |values: &[f32], shape: &[usize]| Intervention {
        key_bias: vec![(
            all(Group::Future),
            OwnedArray::new(values.to_vec(), shape).unwrap(),
        )],
        ..Intervention::default()
    };
    let tokens = |shape: &[usize]| Intervention {
        future_tokens: Some(OwnedArray::new(vec![0.0; shape.iter().product()], shape).unwrap()),
        ..Intervention::default()
    };
    let state = || some(Group::State, &[0]);
    for (intervention, expected) in [
        (
            limited(&[0, 4], &[], &[]),
            "intervention: blocks: expected 0 to 3, got 4",
        ),
        (
            limited(&[], &[3], &[]),
            "intervention: steps: expected 0 to 2, got 3",
        ),
        (
            limited(&[], &[], &[2]),
            "intervention: heads: expected 0 to 1, got 2",
        ),
        (
            cut(state(), some(Group::Future, &[40])),
            "cut: future token 40, expected 0 to 2",
        ),
        (
            cut(some(Group::State, &[1]), state()),
            "cut: state token 1, expected 0 to 0",
        ),
        (
            cut(all(Group::Vl), state()),
            "cut: vl is read, it does not read; expected a reader among state, future, action",
        ),
        (
            bias(&[0.0; 2], &[2]),
            "key_bias: expected a number or (3,) for future, got (2,)",
        ),
        (
            bias(&[f32::NAN], &[]),
            "key_bias: expected numbers below infinity, got NaN",
        ),
        (
            tokens(&[2, 5]),
            "future_tokens: expected (tokens, width) with width 4, got (2, 5)",
        ),
        (
            patch(3, 0, state(), &[1, 4]),
            "patch: step: expected 0 to 2, got 3",
        ),
        (
            patch(0, 4, state(), &[1, 4]),
            "patch: block: expected 0 to 3, got 4",
        ),
        (
            patch(0, 1, state(), &[3, 1, 4]),
            "patch[(0, 1)]: expected (tokens, width) = (1, 4) or (batch, tokens, width) = (2, 1, 4) for state, got (3, 1, 4)",
        ),
        (
            patch(0, 1, all(Group::Vl), &[5, 4]),
            "patch: blocks change rows, not vl; expected state, future or action",
        ),
    ] {
        assert_eq!(message(intervention), expected);
    }
    let mut none_left = cut(state(), some(Group::Future, &[0]));
    none_left.future_tokens = tokens(&[0, 4]).future_tokens;
    assert_eq!(
        message(none_left),
        "cut: future token 0, expected none, since the group has no token"
    );
    let twice = [tokens(&[1, 4]), tokens(&[1, 4])];
    assert_eq!(
        changes(&config(), &twice).err().unwrap().to_string(),
        "future_tokens: expected at most one intervention that replaces them, got several"
    );
    let huge = [bias(&[f32::MAX], &[]), bias(&[f32::MAX], &[])];
    assert_eq!(
        changes(&config(), &huge).err().unwrap().to_string(),
        "key_bias: expected biases whose sum for a key is below infinity"
    );
    let mut many = tokens(&[20_000, 4]);
    many.cut.push((all(Group::State), all(Group::Future)));
    assert!(
        message(many)
            .contains("20003 rows and 20003 keys need 1600480036 bytes, expected at most 1073741824")
    );
}

/// The config has cross-attention in blocks 0 and 2, self-attention in 1 and 3.
#[test]
fn a_change_that_acts_nowhere_is_refused() {
    let cut = |reader, source, blocks: &[usize]| Intervention {
        cut: vec![(all(reader), all(source))],
        blocks: Some(blocks.to_vec()),
        ..Intervention::default()
    };
    let bias = |tokens, blocks: &[usize]| Intervention {
        key_bias: vec![(tokens, OwnedArray::new(vec![1.0], &[]).unwrap())],
        blocks: Some(blocks.to_vec()),
        ..Intervention::default()
    };
    for (intervention, expected) in [
        (
            cut(Group::Future, Group::Vl, &[1, 3]),
            "cut: future reads vl in cross-attention blocks only, which are [0, 2]; expected blocks with at least one of them, got [1, 3]",
        ),
        (
            cut(Group::Action, Group::Future, &[2]),
            "cut: action reads future in self-attention blocks only, which are [1, 3]; expected blocks with at least one of them, got [2]",
        ),
        (
            bias(all(Group::Vl), &[3]),
            "key_bias: vl is read in cross-attention blocks only, which are [0, 2]; expected blocks with at least one of them, got [3]",
        ),
        (
            bias(all(Group::State), &[0]),
            "key_bias: state is read in self-attention blocks only, which are [1, 3]; expected blocks with at least one of them, got [0]",
        ),
        (
            bias(some(Group::Future, &[]), &[1]),
            "key_bias: expected at least one future token, got an empty list",
        ),
    ] {
        assert_eq!(message(intervention), expected);
    }
    for intervention in [
        cut(Group::Future, Group::Vl, &[0, 1]),
        cut(Group::Action, Group::Future, &[2, 3]),
        bias(all(Group::Vl), &[2, 3]),
    ] {
        assert!(
            changes(&config(), &[intervention]).is_ok(),
            "it acts in some of the blocks"
        );
    }
}

#[test]
fn empty_lists_and_groups_are_refused() {
    let empty = || Some(Vec::new());
    let one = Intervention::default;
    for (name, intervention) in [
        (
            "blocks",
            Intervention {
                blocks: empty(),
                ..one()
            },
        ),
        (
            "steps",
            Intervention {
                steps: empty(),
                ..one()
            },
        ),
        (
            "heads",
            Intervention {
                heads: empty(),
                ..one()
            },
        ),
    ] {
        let expected = format!("intervention: {name}: expected at least one index, got an empty list");
        assert_eq!(message(intervention), expected);
    }
    let without_future = |changed: Intervention| Intervention {
        future_tokens: Some(OwnedArray::new(vec![], &[0, 4]).unwrap()),
        ..changed
    };
    let cut = Intervention {
        cut: vec![(all(Group::Future), all(Group::Vl))],
        ..one()
    };
    assert_eq!(
        message(without_future(cut)),
        "cut: expected tokens, but this call has no future tokens"
    );
    assert_eq!(
        message(without_future(patch(0, 1, all(Group::Future), &[0, 4]))),
        "patch[(0, 1)]: expected tokens, but this call has no future tokens"
    );
}

#[test]
fn a_head_of_cross_attention_alone_has_no_other_edges() {
    let config = HeadConfig {
        interleave_self_attention: false,
        ..config()
    };
    let interventions = [Intervention {
        cut: vec![(all(Group::Action), all(Group::Future))],
        ..Intervention::default()
    }];
    assert_eq!(
        changes(&config, &interventions).err().unwrap().to_string(),
        "cut: action reads future in self-attention blocks only, and this head has none"
    );
}
