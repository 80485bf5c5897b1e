//! Guidance: the sampler follows the definition, and what does not fit is refused by name.

mod common;

use common::{HEADS, Inputs, released};
use saccade_vla::{Context, Error, Guidance, Sampling};

/// One Euler step, guided away from `without`.
fn guided(without: &Context, weight: f64) -> Sampling<'_> {
    Sampling {
        num_steps: Some(1),
        guidance: Some(Guidance { without, weight }),
        ..Sampling::default()
    }
}

#[test]
fn a_step_follows_the_two_velocities() {
    for file in HEADS {
        let head = released(file, 2);
        let (with, without) = (Inputs::new(&head, &[0, 1], 9), Inputs::new(&head, &[0, 1], 6));
        let found = with.sample(&guided(&without.context, 2.5)).unwrap();
        let plain = Sampling {
            num_steps: Some(1),
            ..Sampling::default()
        };
        let [first, second] = [&with, &without].map(|inputs| inputs.sample(&plain).unwrap());
        assert_ne!(first, second, "{file}");
        assert_eq!(
            with.sample(&guided(&without.context, 1.0)).unwrap(),
            first,
            "{file}"
        );
        assert_eq!(
            with.sample(&guided(&without.context, 0.0)).unwrap(),
            second,
            "{file}"
        );
        let config = head.config();
        if config.action_dim != config.encoder_action_dim {
            continue; // the sampler sets elements of the noise to zero, and a velocity is of what it is given
        }
        let [v, u] = [&with, &without].map(|inputs| inputs.velocity(0, &[]).unwrap());
        let expected = with.noise().iter().zip(v).zip(u);
        let expected: Vec<f32> = expected.map(|((x, v), u)| x + (u + 2.5 * (v - u))).collect();
        assert_eq!(found, expected, "{file}");
    }
}

#[test]
fn what_does_not_fit_is_named() {
    let [head, other] = [(); 2].map(|()| released(HEADS[0], 1));
    let (with, without) = (Inputs::new(&head, &[0, 1], 9), Inputs::new(&head, &[0, 1], 6));
    let argument = |error: Error| error.argument().map(str::to_owned);
    for weight in [-1.0, -1e-60, f64::NAN, f64::INFINITY, 1e39] {
        let error = with.sample(&guided(&without.context, weight)).unwrap_err();
        assert_eq!(argument(error).as_deref(), Some("guidance"), "{weight}");
    }
    let wrong = [Inputs::new(&head, &[0], 9), Inputs::new(&other, &[0, 1], 9)];
    for wrong in wrong {
        for weight in [1.0, 2.0] {
            let error = with.sample(&guided(&wrong.context, weight)).unwrap_err();
            assert_eq!(argument(error).as_deref(), Some("without"));
        }
    }
    let sampling = Sampling {
        num_steps: None,
        ..guided(&without.context, 2.0)
    };
    let error = with.trace(&sampling, &Default::default()).unwrap_err();
    assert_eq!(argument(error).as_deref(), Some("guidance"));
}
