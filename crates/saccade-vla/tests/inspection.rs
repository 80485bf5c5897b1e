//! What interventions mean, where they act, what a trace records, and what is refused.

mod common;

use std::sync::LazyLock;

use common::{Inputs, made_up};
use saccade_vla::{
    ActionHead, Group, Intervention, Keep, OwnedArray, Patch, Sampling, Tokens, Trace, TraceOptions,
};
use serde_json::{Value, json};

/// Four blocks, two heads, three future and two action rows, width 4.
fn config() -> Value {
    json!({
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
    })
}

static HEAD: LazyLock<ActionHead> = LazyLock::new(|| made_up(&config().to_string()));

const NUM_STEPS: usize = 3;
const ROWS: usize = 6;
/// Rows: state 0, future 1 to 3, action 4 and 5.
const FIRST_ACTION: usize = 4;

/// Two observations of five tokens.
fn inputs(head: &ActionHead) -> Inputs<'_> {
    Inputs::new(head, &[0, 1], 5)
}

fn sampling(interventions: &[Intervention]) -> Sampling<'_> {
    Sampling {
        num_steps: Some(NUM_STEPS),
        interventions,
        ..Sampling::default()
    }
}

/// A trace of everything, whose actions are those of a call without one.
fn trace(head: &ActionHead, interventions: &[Intervention]) -> Trace {
    let options = TraceOptions {
        record: Keep {
            attention: true,
            hidden: true,
        },
        ..TraceOptions::default()
    };
    let (inputs, sampling) = (inputs(head), sampling(interventions));
    let trace = inputs.trace(&sampling, &options).unwrap();
    // Only the action rows run in the last block, and chunks of the same noise are the same.
    assert_eq!(inputs.sample(&sampling).unwrap(), trace.actions.data());
    let chunk = trace.actions.data().len() / 2;
    let thrice = trace
        .actions
        .data()
        .chunks(chunk)
        .flat_map(|chunk| chunk.repeat(3));
    assert!(
        inputs
            .sample_repeatedly(3, &sampling)
            .unwrap()
            .into_iter()
            .eq(thrice)
    );
    trace
}

fn message(interventions: &[Intervention]) -> String {
    let result = inputs(&HEAD).sample(&sampling(interventions));
    result.expect_err("an error").to_string()
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

fn array(values: &[f32], shape: &[usize]) -> OwnedArray {
    OwnedArray::new(values.to_vec(), shape).unwrap()
}

fn cut(reader: Tokens, source: Tokens) -> Intervention {
    Intervention {
        cut: vec![(reader, source)],
        ..Intervention::default()
    }
}

fn bias(tokens: Tokens, values: &[f32], shape: &[usize]) -> Intervention {
    Intervention {
        key_bias: vec![(tokens, array(values, shape))],
        ..Intervention::default()
    }
}

fn future_tokens(shape: &[usize]) -> Intervention {
    Intervention {
        future_tokens: Some(array(&vec![0.0; shape.iter().product()], shape)),
        ..Intervention::default()
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

/// Patches of all rows before every self-attention block: what these blocks read is the same in all traces.
fn same_rows() -> Intervention {
    let of = |step, block| {
        [(Group::State, 1), (Group::Future, 3), (Group::Action, 2)]
            .map(|(group, count)| patch(step, block, all(group), &[count, 4]).patch)
    };
    let places = (0..NUM_STEPS).flat_map(|step| [(step, 0), (step, 2)]);
    Intervention {
        patch: places
            .flat_map(|(step, block)| of(step, block))
            .flatten()
            .collect(),
        ..Intervention::default()
    }
}

/// The probabilities of one observation's head and query.
fn probabilities(trace: &Trace, place: (usize, usize), [observation, head, query]: [usize; 3]) -> &[f32] {
    let attention = &trace.recorded.attention[&place];
    let &[_, heads, queries, keys] = attention.shape() else {
        panic!("(batch, heads, queries, keys)")
    };
    &attention.data()[((observation * heads + head) * queries + query) * keys..][..keys]
}

/// Checks what is added in `changed` to the logits of a head's keys, relative to the first key.
fn assert_adds(plain: &Trace, changed: &Trace, place: (usize, usize), head: usize, expected: &[f32]) {
    for (observation, query) in
        (0..2).flat_map(|observation| (0..ROWS).map(move |query| (observation, query)))
    {
        let of = [plain, changed].map(|trace| probabilities(trace, place, [observation, head, query]));
        let ratios = of[1].iter().zip(of[0]).map(|(changed, plain)| changed / plain);
        let ratios: Vec<f32> = ratios.collect();
        for (ratio, expected) in ratios.iter().zip(expected) {
            let error = ratio / ratios[0] - expected.exp();
            assert!(
                error.abs() < 1e-4 * expected.exp().max(1.0),
                "{place:?}: {ratios:?}"
            );
        }
    }
}

#[test]
fn a_cut_is_where_its_keys_are() {
    let interventions = [Intervention {
        cut: vec![
            (some(Group::Action, &[1]), some(Group::Future, &[2, 0])),
            (all(Group::Future), some(Group::Vl, &[4])),
        ],
        ..Intervention::default()
    }];
    let trace = trace(&HEAD, &interventions);
    for (place, attention) in &trace.recorded.attention {
        for (index, keys) in attention.data().chunks(attention.shape()[3]).enumerate() {
            let query = index % ROWS;
            let removed: &[usize] = match place.1 {
                1 | 3 if query == 5 => &[1, 3],
                0 | 2 if (1..FIRST_ACTION).contains(&query) => &[4],
                _ => &[],
            };
            for (key, probability) in keys.iter().enumerate() {
                assert_eq!(
                    *probability == 0.0,
                    removed.contains(&key),
                    "{place:?}, {query}: {keys:?}"
                );
            }
        }
    }
}

#[test]
fn biases_of_several_add_up_where_they_act_together() {
    let first = Intervention {
        heads: Some(vec![1]),
        ..bias(some(Group::Future, &[2, 1]), &[1.0, 2.0], &[2])
    };
    let second = Intervention {
        blocks: Some(vec![3]),
        steps: Some(vec![2, 0]),
        ..bias(all(Group::Future), &[0.25], &[])
    };
    let plain = trace(&HEAD, &[same_rows()]);
    let changed = trace(&HEAD, &[first, second, same_rows()]);
    let of_first = [0.0, 0.0, 2.0, 1.0, 0.0, 0.0];
    for (place, head, expected) in [
        ((1, 3), 0, [0.0; 6]),
        ((1, 3), 1, of_first),
        ((0, 1), 1, of_first),
        ((2, 3), 0, [0.0, 0.25, 0.25, 0.25, 0.0, 0.0]),
        ((2, 3), 1, [0.0, 0.25, 2.25, 1.25, 0.0, 0.0]),
    ] {
        assert_adds(&plain, &changed, place, head, &expected);
    }
}

#[test]
fn a_head_that_is_listed_twice_gets_its_bias_once() {
    let twice = Intervention {
        heads: Some(vec![1, 1]),
        ..bias(all(Group::Future), &[0.25], &[])
    };
    let (plain, changed) = (trace(&HEAD, &[same_rows()]), trace(&HEAD, &[twice, same_rows()]));
    assert_adds(&plain, &changed, (0, 1), 0, &[0.0; 6]);
    assert_adds(&plain, &changed, (0, 1), 1, &[0.0, 0.25, 0.25, 0.25, 0.0, 0.0]);
}

#[test]
fn the_configs_own_bias_is_in_every_self_attention_block_and_under_all_others() {
    let mut with_bias = config();
    with_bias["saccade"] = json!({"future_key_bias": [0.5, -1.0, 2.0]});
    let own_head = made_up(&with_bias.to_string());
    let plain = trace(&HEAD, &[same_rows()]);
    let own = trace(&own_head, &[same_rows()]);
    let place_and_head = [(0, 1), (2, 3)]
        .into_iter()
        .flat_map(|place| [(place, 0), (place, 1)]);
    for (place, head) in place_and_head {
        assert_adds(&plain, &own, place, head, &[0.0, 0.5, -1.0, 2.0, 0.0, 0.0]);
    }
    assert_eq!(
        plain.recorded.attention[&(0, 0)],
        own.recorded.attention[&(0, 0)],
        "cross-attention has no future keys"
    );
    let limited = Intervention {
        cut: vec![(some(Group::State, &[0]), some(Group::Future, &[1]))],
        key_bias: vec![(all(Group::Future), array(&[0.25], &[]))],
        steps: Some(vec![1]),
        ..same_rows()
    };
    let both = trace(&own_head, std::slice::from_ref(&limited));
    assert_eq!(both.recorded.attention[&(0, 1)], own.recorded.attention[&(0, 1)]);
    let without = Intervention {
        key_bias: Vec::new(),
        ..limited.clone()
    };
    let added = Intervention {
        cut: Vec::new(),
        ..limited
    };
    let (without, added) = (trace(&HEAD, &[without]), trace(&own_head, &[added]));
    assert_adds(&plain, &added, (1, 1), 0, &[0.0, 0.75, -0.75, 2.25, 0.0, 0.0]);
    for observation in 0..2 {
        for trace in [&both, &without] {
            let of_state = probabilities(trace, (1, 1), [observation, 0, 0]);
            assert!(
                of_state
                    .iter()
                    .enumerate()
                    .all(|(key, value)| (key == 2) == (*value == 0.0))
            );
        }
        let of_future = [&both, &added].map(|trace| probabilities(trace, (1, 1), [observation, 0, 1]));
        assert_eq!(of_future[0], of_future[1], "the cut is the state's");
    }

    let replaced = [future_tokens(&[2, 4])];
    assert_eq!(
        trace(&own_head, &replaced).recorded.attention,
        trace(&HEAD, &replaced).recorded.attention,
        "it is the learned tokens' own"
    );
}

#[test]
fn what_adds_nothing_changes_nothing() {
    let limited = Intervention {
        blocks: Some(vec![1]),
        ..Intervention::default()
    };
    let (plain, changed) = (trace(&HEAD, &[]), trace(&HEAD, &[limited]));
    assert_eq!(plain.recorded.attention, changed.recorded.attention);
    assert_eq!(plain.actions, changed.actions);
    let none = trace(&HEAD, &[future_tokens(&[0, 4])]);
    assert_eq!((none.groups.future, none.groups.num_rows()), (0, 3));
}

#[test]
fn patches_replace_rows() {
    let interventions = [
        patch(1, 2, some(Group::Action, &[1, 0]), &[2, 2, 4]),
        patch(1, 2, all(Group::State), &[1, 4]),
    ];
    let (plain, changed) = (trace(&HEAD, &[]), trace(&HEAD, &interventions));
    for place in [(0, 2), (0, 3), (1, 1)] {
        let [plain, changed] = [&plain, &changed].map(|trace| &trace.recorded.hidden[&place]);
        assert_eq!(plain, changed, "before");
    }
    let [plain, changed] =
        [&plain, &changed].map(|trace| trace.recorded.hidden[&(1, 2)].data().chunks(ROWS * 4));
    for (observation, (plain, changed)) in plain.zip(changed).enumerate() {
        let first = (observation * 8) as f32;
        assert_eq!(changed[..4], [0.0, 1.0, 2.0, 3.0]);
        assert_eq!(changed[4..16], plain[4..16]);
        assert_eq!(changed[16..20], [4.0, 5.0, 6.0, 7.0].map(|value| first + value));
        assert_eq!(changed[20..], [0.0, 1.0, 2.0, 3.0].map(|value| first + value));
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
    let state = || some(Group::State, &[0]);
    let future = || all(Group::Future);
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
            bias(future(), &[0.0; 2], &[2]),
            "key_bias: expected a number or (3,) for future, got (2,)",
        ),
        (
            bias(future(), &[f32::NAN], &[]),
            "key_bias: expected numbers below infinity, got NaN",
        ),
        (
            future_tokens(&[2, 5]),
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
        assert_eq!(message(&[intervention]), expected);
    }
    let none_left = Intervention {
        cut: cut(state(), some(Group::Future, &[0])).cut,
        ..future_tokens(&[0, 4])
    };
    assert_eq!(
        message(&[none_left]),
        "cut: future token 0, expected none, since the group has no token"
    );
    let twice = [future_tokens(&[1, 4]), future_tokens(&[1, 4])];
    assert_eq!(
        message(&twice),
        "future_tokens: expected at most one intervention that replaces them, got several"
    );
    let huge = || bias(future(), &[f32::MAX], &[]);
    assert_eq!(
        message(&[huge(), huge()]),
        "key_bias: expected biases whose sum for a key is below infinity"
    );
    let many = Intervention {
        cut: cut(all(Group::State), future()).cut,
        ..future_tokens(&[20_000, 4])
    };
    let expected = "20003 rows and 20003 keys need 1600480036 bytes, expected at most 1073741824";
    assert!(message(&[many]).contains(expected));
}

/// The config has cross-attention in blocks 0 and 2, self-attention in 1 and 3.
#[test]
fn a_change_that_acts_nowhere_is_refused() {
    let cut = |reader, source, blocks: &[usize]| Intervention {
        blocks: Some(blocks.to_vec()),
        ..cut(all(reader), all(source))
    };
    let bias = |tokens, blocks: &[usize]| Intervention {
        blocks: Some(blocks.to_vec()),
        ..bias(tokens, &[1.0], &[])
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
        assert_eq!(message(&[intervention]), expected);
    }
    for intervention in [
        cut(Group::Future, Group::Vl, &[0, 1]),
        cut(Group::Action, Group::Future, &[2, 3]),
        bias(all(Group::Vl), &[2, 3]),
    ] {
        let acts_in_some = inputs(&HEAD).sample(&sampling(&[intervention]));
        assert!(acts_in_some.is_ok());
    }
}

#[test]
fn empty_lists_and_groups_are_refused() {
    let (empty, one) = (|| Some(Vec::new()), Intervention::default);
    let [mut blocks, mut steps, mut heads] = [one(), one(), one()];
    (blocks.blocks, steps.steps, heads.heads) = (empty(), empty(), empty());
    for (name, intervention) in [("blocks", blocks), ("steps", steps), ("heads", heads)] {
        let expected = format!("intervention: {name}: expected at least one index, got an empty list");
        assert_eq!(message(&[intervention]), expected);
    }
    let without_future = |changed: Intervention| Intervention {
        future_tokens: Some(array(&[], &[0, 4])),
        ..changed
    };
    assert_eq!(
        message(&[without_future(cut(all(Group::Future), all(Group::Vl)))]),
        "cut: expected tokens, but this call has no future tokens"
    );
    assert_eq!(
        message(&[without_future(patch(0, 1, all(Group::Future), &[0, 4]))]),
        "patch[(0, 1)]: expected tokens, but this call has no future tokens"
    );
}

#[test]
fn a_head_of_cross_attention_alone_has_no_other_edges() {
    let mut config = config();
    config["diffusion_model_cfg"]["interleave_self_attention"] = false.into();
    let head = made_up(&config.to_string());
    let interventions = [cut(all(Group::Action), all(Group::Future))];
    assert_eq!(
        inputs(&head)
            .sample(&sampling(&interventions))
            .unwrap_err()
            .to_string(),
        "cut: action reads future in self-attention blocks only, and this head has none"
    );
}

#[test]
fn one_byte_too_much_is_refused() {
    let options = |max_bytes, is_recorded| TraceOptions {
        record: Keep {
            attention: is_recorded,
            hidden: is_recorded,
        },
        blocks: Some(vec![0, 1]),
        steps: Some(vec![0, 2]),
        max_bytes,
    };
    // Rows and probabilities of two steps, in the blocks of two heads over 5 tokens and over the rows.
    let bytes = 4 * 2 * 2 * ROWS as u64 * (2 * 4 + 2 * 5 + 2 * 6);
    let trace = |options| inputs(&HEAD).trace(&sampling(&[]), &options);
    let recorded = trace(options(bytes, true)).unwrap().recorded;
    assert_eq!(recorded.attention[&(2, 1)].shape(), [2, 2, ROWS, ROWS]);
    assert_eq!(recorded.hidden[&(0, 0)].shape(), [2, ROWS, 4]);
    assert_eq!(
        trace(options(bytes - 1, true)).unwrap_err().to_string(),
        format!(
            "max_bytes: what is to be recorded takes {bytes} bytes, expected at most {}; record less at a time",
            bytes - 1
        )
    );
    let nothing = trace(options(0, false)).unwrap().recorded;
    assert!(nothing.attention.is_empty() && nothing.hidden.is_empty());
}
