//! Profiles count what a thread does between their start and end.

mod common;

use common::{HEADS, Inputs, released};
use saccade_vla::{Counter, Part, Profile};

/// What is counted of the queries.
fn queries(profile: &Profile) -> [u64; 3] {
    let Counter {
        calls,
        multiply_adds,
        bytes,
        ..
    } = profile.part(Part::ToQ);
    [calls, multiply_adds, bytes]
}

#[test]
fn counts_between_start_and_finish_on_this_thread_only() {
    let head = released(HEADS[0], 1);
    let inputs = Inputs::new(&head, &[0], 9);
    let work = || drop(inputs.velocity(5, &[]).unwrap());
    work();
    let profiling = Profile::start();
    work();
    let once = profiling.finish();
    assert_eq!(queries(&once)[0], head.config().num_layers as u64);
    assert!(queries(&once).iter().all(|count| *count > 0) && once.part(Part::ToQ).kernel.is_some());
    assert_eq!(once.part(Part::Patches), Counter::default(), "a head has none");

    let profiling = Profile::start();
    std::thread::scope(|scope| {
        scope.spawn(work);
    });
    work();
    work();
    assert_eq!(
        queries(&profiling.finish()),
        queries(&once).map(|count| 2 * count)
    );
    work();
    assert_eq!(
        Profile::start().finish(),
        Profile::default(),
        "nothing is counted in between"
    );
}

#[test]
fn a_guard_counts_what_others_count_as_well() {
    let head = released(HEADS[0], 1);
    let inputs = Inputs::new(&head, &[0], 9);
    let work = || drop(inputs.velocity(5, &[]).unwrap());
    let calls = |profile: Profile| queries(&profile)[0] / head.config().num_layers as u64;
    let first = Profile::start();
    work();
    let second = Profile::start();
    work();
    assert_eq!(calls(first.finish()), 2);
    work();
    assert_eq!(calls(second.finish()), 2);
}
