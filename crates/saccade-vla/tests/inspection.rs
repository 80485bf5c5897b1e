//! What interventions mean, where they act, and what a trace records.

mod common;

use common::interventions::{
    FIRST_ACTION, HEAD, NUM_STEPS, ROWS, all, array, bias, config, future_tokens, inputs, patch, sampling,
    some,
};
use common::made_up;
use saccade_vla::{ActionHead, Group, Intervention, Keep, Trace, TraceOptions};
use serde_json::json;

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
