//! Arguments are checked: those that are written to as those that are read.

mod common;

use std::error::Error as _;

use saccade_vla::{
    ActionHead, Array, ArrayMut, CrossAttention, ElementsRef, Error, ErrorKind, Features, HeadConfig,
    KeyOptions, LoadOptions, NoisyActions, OwnedArray, Precision, Sampling, TensorView, TensorViews,
};
use saccade_vla_kernels::KernelError;

fn demo() -> ActionHead {
    let options = LoadOptions {
        num_threads: Some(1),
        ..LoadOptions::default()
    };
    ActionHead::load(&common::demo(), &options).unwrap()
}

#[test]
fn an_out_of_the_wrong_shape_is_an_error_and_stays_as_it_is() {
    let head = demo();
    let config = head.config();
    let (horizon, width) = (config.action_horizon, config.action_dim);
    let features = vec![0.1; 2 * 7 * config.context_dim];
    let shape = [2, 7, config.context_dim];
    let context = head
        .encode(&Features::new(Array::new(&features, &shape).unwrap()))
        .unwrap();
    let state = vec![0.0; 2 * config.state_dim];
    let state_shape = [2, config.state_dim];
    let state = Array::new(&state, &state_shape).unwrap();
    let noise = vec![0.5; 2 * 3 * horizon * config.encoder_action_dim];
    for wrong in [
        vec![2, horizon, width],
        vec![2, 3, horizon, width + 1],
        vec![2, 3, horizon - 1, width],
        vec![2 * 3 * horizon * width],
        vec![],
    ] {
        let mut out = vec![7.0; wrong.iter().product()];
        let result = head.sample(
            &context,
            state,
            Array::new(&[0], &[]).unwrap(),
            Array::new(&noise, &[2, 3, horizon, config.encoder_action_dim]).unwrap(),
            &Sampling {
                num_samples: Some(3),
                ..Sampling::default()
            },
            ArrayMut::new(&mut out, &wrong).unwrap(),
        );
        let Err(Error::Shape(problem)) = result else {
            panic!("sample, {wrong:?}: {result:?}")
        };
        let (expected, _) = problem.sides().unwrap();
        assert!(
            expected.starts_with("(batch, num_samples, action_horizon, action_dim) = (2, 3, "),
            "{problem}"
        );
        assert_eq!(problem.argument(), Some("out"));
        let actions_shape = [2, horizon, config.encoder_action_dim];
        let actions = &noise[..actions_shape.iter().product()];
        let noisy = NoisyActions {
            actions: Array::new(actions, &actions_shape).unwrap(),
            timestep: Array::new(&[5], &[]).unwrap(),
        };
        if wrong != [2, horizon, width] {
            let out_array = ArrayMut::new(&mut out, &wrong).unwrap();
            let ids = Array::new(&[0], &[]).unwrap();
            let result = head.velocity(&context, state, ids, noisy, &[], out_array);
            assert!(
                matches!(result, Err(Error::Shape(_))),
                "velocity, {wrong:?}: {result:?}"
            );
        }
        assert!(out.iter().all(|value| *value == 7.0));
    }
}

#[test]
fn outputs_of_a_cross_attention_are_checked() {
    let (square, bias) = (vec![0.1; 64], vec![0.0; 8]);
    let mut tensors = TensorViews::new();
    for name in ["to_q", "to_k", "to_v", "to_out.0"] {
        let weight = TensorView::new(&[8, 8], ElementsRef::F32(&square)).unwrap();
        tensors.insert(format!("{name}.weight"), weight);
        let bias = TensorView::new(&[8], ElementsRef::F32(&bias)).unwrap();
        tensors.insert(format!("{name}.bias"), bias);
    }
    let layer = CrossAttention::new(&tensors, 2, Precision::Float32, Some(1)).unwrap();
    let rows = vec![0.3; 3 * 8];
    let rows = Array::new(&rows, &[1, 3, 8]).unwrap();
    let kv = layer.project(rows).unwrap();
    for (out_shape, weights_shape) in [
        ([1, 3, 7], [1, 2, 3, 3]),
        ([3, 1, 8], [1, 2, 3, 3]),
        ([1, 3, 8], [2, 1, 3, 3]),
        ([1, 3, 8], [1, 2, 3, 2]),
    ] {
        let mut out = vec![7.0; out_shape.iter().product()];
        let mut weights = vec![7.0; weights_shape.iter().product()];
        let result = layer.attend(
            rows,
            &kv,
            KeyOptions::default(),
            Some(ArrayMut::new(&mut weights, &weights_shape).unwrap()),
            ArrayMut::new(&mut out, &out_shape).unwrap(),
        );
        assert!(
            matches!(result, Err(Error::Shape(_))),
            "{out_shape:?}, {weights_shape:?}"
        );
        assert!(out.iter().chain(&weights).all(|value| *value == 7.0));
    }
}

#[test]
fn every_kind_of_bad_element_is_found_and_named_wherever_it_is() {
    let head = demo();
    let width = head.config().context_dim;
    let shape = [2, 2100 / width + 1, width];
    let mut features = vec![1e30; shape.iter().product()];
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -f32::NAN] {
        for position in [0, 1, 1023, 1024, 2053, features.len() - 1] {
            features[position] = bad;
            let error = head
                .encode(&Features::new(Array::new(&features, &shape).unwrap()))
                .err()
                .unwrap();
            features[position] = 1e30;
            let token = position / width;
            let index = format!(
                "({}, {}, {})",
                token / shape[1],
                token % shape[1],
                position % width
            );
            assert_eq!(
                error.to_string(),
                format!("backbone_features: expected finite values, got {bad} at index {index}")
            );
        }
    }
}

#[test]
fn a_shape_that_does_not_fit_is_an_error() {
    let mut data = [0.0; 6];
    let largest = format!("({}, 2)", usize::MAX);
    for (shape, shown) in [
        (&[2, 2][..], "(2, 2)"),
        (&[], "()"),
        (&[usize::MAX, 2], &largest),
        (&[7], "(7,)"),
    ] {
        let messages = [
            Array::new(&data, shape).unwrap_err().to_string(),
            OwnedArray::new(data.to_vec(), shape).unwrap_err().to_string(),
            ArrayMut::new(&mut data, shape).unwrap_err().to_string(),
        ];
        let expected = format!("shape: {shown} does not fit 6 elements");
        assert_eq!(messages, [expected.clone(), expected.clone(), expected]);
    }
}

#[test]
fn causes_are_kept() {
    let error = HeadConfig::from_json("{").unwrap_err();
    assert!(error.source().unwrap().is::<serde_json::Error>());
    assert_eq!(error.kind(), ErrorKind::Checkpoint);
    assert!(
        error.to_string().starts_with("config: not valid JSON: "),
        "{error}"
    );
    // More inputs than sums of products of int8 hold.
    let weight = vec![0.0; 70_000];
    let tensors: TensorViews<'_> = [("to_q", 1), ("to_k", 70_000), ("to_v", 70_000), ("to_out.0", 1)]
        .into_iter()
        .flat_map(|(layer, inputs)| {
            let view =
                |shape: &[usize], len| TensorView::new(shape, ElementsRef::F32(&weight[..len])).unwrap();
            [
                (format!("{layer}.weight"), view(&[1, inputs], inputs)),
                (format!("{layer}.bias"), view(&[1], 1)),
            ]
        })
        .collect();
    let error = CrossAttention::new(&tensors, 1, Precision::Int8, Some(1))
        .err()
        .unwrap();
    assert!(error.source().unwrap().is::<KernelError>());
    assert_eq!(error.kind(), ErrorKind::Checkpoint);
}
