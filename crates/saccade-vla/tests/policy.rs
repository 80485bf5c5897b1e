//! A policy has the bits of its parts, called one after the other.

mod common;

use std::path::Path;
use std::time::Duration;

use saccade_vla::{
    Array, ArrayMut, BackboneFeatures, BackboneKeep, BackboneLoadOptions, Error, FeatureBatch, Features,
    Frame, LoadOptions, Observation, Policy, PolicyContext, PolicyLoadOptions, Sampling, interruptible,
};

const SIDE: usize = 68;
const SHAPE: [usize; 3] = [SIDE, SIDE, 3];

fn demo() -> Policy {
    demo_on(1)
}

fn demo_on(threads: usize) -> Policy {
    let num_threads = Some(threads);
    let backbone = BackboneLoadOptions {
        num_threads,
        ..BackboneLoadOptions::default()
    };
    let head = LoadOptions {
        num_threads,
        ..LoadOptions::default()
    };
    let options = PolicyLoadOptions {
        backbone,
        head,
        ..PolicyLoadOptions::default()
    };
    Policy::load(&common::demo(), &options).unwrap()
}

fn picture(seed: usize) -> Vec<u8> {
    (0..SHAPE.iter().product())
        .map(|index: usize| (index.wrapping_mul(2_654_435_761 + seed) >> 7) as u8)
        .collect()
}

fn observation<'a>(pictures: &'a [Vec<u8>], words: &'a str) -> Observation<'a> {
    let views = pictures
        .iter()
        .map(|pixels| (None, Frame::U8(Array::new(pixels, &SHAPE).unwrap())));
    Observation {
        views: views.collect(),
        instruction: Some(words),
        ..Observation::default()
    }
}

/// What is sampled for each observation from the same noise, with the state in the middle of its range.
fn actions(policy: &Policy, context: &PolicyContext) -> Vec<Vec<f32>> {
    let config = policy.head.config();
    let batch = context.batch();
    let state_shape = [batch, config.num_states, config.state_dim];
    let noise_shape = [batch, config.action_horizon, config.encoder_action_dim];
    let shape = [batch, config.action_horizon, config.action_dim];
    let chunk = config.action_horizon * config.encoder_action_dim;
    let noise: Vec<f32> = (0..batch * chunk)
        .map(|index| ((index % chunk) as f32).sin())
        .collect();
    let mut out = vec![0.0; shape.iter().product()];
    policy
        .sample(
            context,
            Array::new(&vec![0.0; state_shape.iter().product()], &state_shape).unwrap(),
            Array::new(&[0], &[]).unwrap(),
            Array::new(&noise, &noise_shape).unwrap(),
            &Sampling::default(),
            ArrayMut::new(&mut out, &shape).unwrap(),
        )
        .unwrap();
    out.chunks(out.len() / batch).map(<[f32]>::to_vec).collect()
}

#[test]
fn one_call_is_the_parts_one_after_the_other() {
    let policy = demo();
    let pictures = [1, 2, 3].map(picture);
    let seen = observation(&pictures, "open the drawer");
    let prepared = policy.processor.process(std::slice::from_ref(&seen)).unwrap();
    let features = policy
        .backbone
        .encode(&[prepared.as_inputs()], &[], BackboneKeep::default())
        .unwrap();
    let shape = [1, features[0].num_tokens(), features[0].feature_dim()];
    let image_mask: Vec<bool> = prepared
        .input_ids
        .data()
        .iter()
        .map(|&id| id == i64::from(policy.processor.image_token_id()))
        .collect();
    let given = Features {
        image_mask: Some(Array::new(&image_mask, &shape[..2]).unwrap()),
        ..Features::new(Array::new(features[0].features(0), &shape).unwrap())
    };
    let expected = policy.head.encode(&given).unwrap();

    let found = policy.encode(&[seen], None).unwrap();
    assert_eq!((found.batch(), found.num_vl_tokens()), (1, shape[1]));
    assert!(found.features[0].features(0) == features[0].features(0));
    assert!(found.context.vl_embs() == expected.vl_embs());
    assert_eq!(found.context.image_mask(), Some(&image_mask[..]));
}

#[test]
fn each_of_several_has_the_bits_that_it_has_alone() {
    let policy = demo();
    let pictures = [1, 2, 3].map(picture);
    let observations = [
        observation(&pictures, "open the drawer"),
        observation(
            &pictures[1..],
            "pick up the red block and put it behind the blue mug",
        ),
        observation(&pictures[..1], ""),
        observation(&pictures, "open the drawer"),
    ];
    let together = policy.encode(&observations, None).unwrap();
    let sampled = actions(&policy, &together);
    for (index, seen) in observations.iter().enumerate() {
        let alone = policy.encode(std::slice::from_ref(seen), None).unwrap();
        let reused = policy
            .encode(std::slice::from_ref(seen), Some(&together))
            .unwrap();
        let features = together.features[index].features(0);
        let width = together.features[index].feature_dim();
        let rows = &together.context.vl_embs()[index * together.num_vl_tokens() * width..];
        for context in [&alone, &reused] {
            assert!(context.features[0].features(0) == features);
            assert!(
                context.context.vl_embs() == &rows[..features.len()],
                "observation {index}"
            );
            assert!(
                actions(&policy, context)[0] == sampled[index],
                "observation {index}"
            );
        }
    }
    let lengths: Vec<usize> = together.features.iter().map(|one| one.num_tokens()).collect();
    assert!(lengths.iter().any(|length| length != &lengths[0]));
}

#[test]
fn features_from_elsewhere_are_checked() {
    let policy = demo();
    let pictures = [picture(1)];
    let encoded = policy.encode(&[observation(&pictures, "push")], None).unwrap();
    let features: [&BackboneFeatures; 1] = [&encoded.features[0]];
    let batch = FeatureBatch::new(&features).unwrap();
    let mut given = batch.as_features();
    assert!(policy.head.encode(&given).is_ok());
    // Those of the batch are known to be finite; others in their place are not.
    let mut other = given.backbone_features.data().to_vec();
    other[7] = f32::NAN;
    given.backbone_features = Array::new(&other, given.backbone_features.shape()).unwrap();
    let error = policy.head.encode(&given).err().unwrap().to_string();
    assert!(
        error.starts_with("backbone_features: expected finite values, got NaN"),
        "{error}"
    );
}

#[test]
fn what_does_not_fit_is_an_error() {
    let (policy, other) = (demo(), demo());
    let pictures = [1, 2].map(picture);
    let good = observation(&pictures, "push");
    let context = other.encode(std::slice::from_ref(&good), None).unwrap();
    let errors = [
        policy.encode(&[], None),
        policy.encode(&[good.clone(), observation(&[], "push")], None),
        policy.encode(&[observation(&pictures, "<IMG_CONTEXT>")], None),
        policy.encode(&[good], Some(&context)),
    ];
    let expected = [
        "observations: expected at least one",
        "frames: expected at least one view",
        "instruction: expected no token that stands for an image",
        "previous: expected features that this backbone made",
    ];
    for (result, expected) in errors.into_iter().zip(expected) {
        let error = result.err().unwrap().to_string();
        assert!(error.starts_with(expected), "{error}");
    }
    let missing = Policy::load(Path::new("no-such-checkpoint"), &PolicyLoadOptions::default());
    assert!(missing.err().unwrap().to_string().contains("no-such-checkpoint"));
}

#[test]
fn frames_that_several_threads_prepare_have_the_bits_of_one() {
    let (alone, together) = (demo(), demo_on(3));
    let pictures: Vec<_> = (0..9).map(picture).collect();
    let seen = [
        observation(&pictures[..3], "push"),
        observation(&pictures[3..4], "open the drawer"),
        observation(&pictures[4..], "reach"),
    ];
    let expected = alone.encode(&seen, None).unwrap();
    let found = together.encode(&seen, None).unwrap();
    assert_eq!(actions(&together, &found), actions(&alone, &expected));
    assert!(found.context.vl_embs() == expected.context.vl_embs());
}

#[test]
fn a_frame_that_is_none_is_named_by_its_place() {
    let pictures = [1, 2, 3].map(picture);
    let empty: [u8; 0] = [];
    for threads in [1, 3] {
        let policy = demo_on(threads);
        let mut wrong = observation(&pictures, "push");
        wrong.views[1] = (None, Frame::U8(Array::new(&empty, &[0, SIDE, 3]).unwrap()));
        wrong.views[2] = (
            Some("wrist"),
            Frame::U8(Array::new(&pictures[2], &[3 * SIDE * SIDE]).unwrap()),
        );
        let error = policy.encode(&[observation(&pictures, "push"), wrong.clone()], None);
        let error = error.err().unwrap().to_string();
        assert!(error.starts_with("frames[1]: expected an RGB frame"), "{error}");
        wrong.views.remove(1);
        let error = policy.encode(&[wrong], None).err().unwrap().to_string();
        assert!(
            error.starts_with("frames['wrist']: expected an RGB frame"),
            "{error}"
        );
    }
}

#[test]
fn a_call_stops_when_it_is_asked_to() {
    let policy = demo();
    let pictures = [picture(1)];
    let seen = [observation(&pictures, "push")];
    let stopped = interruptible(&|| true, || {
        std::thread::sleep(Duration::from_millis(30));
        policy.encode(&seen, None)
    });
    assert!(matches!(stopped, Err(Error::Interrupted)));
    assert!(policy.encode(&seen, None).is_ok());
}

#[test]
fn callers_at_the_same_time_get_the_same_bits() {
    let policy = demo();
    let pictures = [1, 2].map(picture);
    let expected = policy.encode(&[observation(&pictures, "push")], None).unwrap();
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| {
                let found = policy
                    .encode(&[observation(&pictures, "push")], Some(&expected))
                    .unwrap();
                assert!(found.context.vl_embs() == expected.context.vl_embs());
            });
        }
    });
}
