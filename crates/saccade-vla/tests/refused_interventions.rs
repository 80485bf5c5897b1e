//! Which interventions are refused, and in which words.

mod common;

use common::interventions::{
    HEAD, ROWS, all, array, bias, config, cut, future_tokens, inputs, patch, sampling, some,
};
use common::made_up;
use saccade_vla::{Group, Intervention, Keep, TraceOptions};

fn message(interventions: &[Intervention]) -> String {
    let result = inputs(&HEAD).sample(&sampling(interventions));
    result.expect_err("an error").to_string()
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
