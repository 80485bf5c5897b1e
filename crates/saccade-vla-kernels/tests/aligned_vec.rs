//! Vectors of activations: capacity, length and alignment.

use saccade_vla_kernels::{AlignedVec, AllocError};

/// Elements that fill huge pages.
const HUGE_PAGE: usize = 2 << 20;

#[test]
fn elements_are_kept_within_their_memory() {
    let mut vector = AlignedVec::new();
    assert!(vector.is_empty());
    vector.reserve(3).unwrap();
    vector.resize(3);
    vector.copy_from_slice(&[1.0, 2.0, 3.0]);
    for (len, expected) in [(2, &[1.0, 2.0][..]), (3, &[1.0, 2.0, 0.0]), (0, &[])] {
        vector.reserve(len).unwrap();
        vector.resize(len);
        assert_eq!(vector[..], *expected);
    }
}

#[test]
fn another_allocation_begins_empty() {
    let mut vector = AlignedVec::new();
    for len in [3, HUGE_PAGE] {
        vector.reserve(len).unwrap();
        assert!(vector.is_empty());
        vector.resize(len);
        assert!(vector.iter().all(|&element| element == 0.0));
        vector.fill(1.0);
    }
    let error = vector.reserve(usize::MAX / 2).unwrap_err();
    assert_eq!(error, AllocError { bytes: usize::MAX });
    assert!(vector.is_empty());
    vector.reserve(HUGE_PAGE).unwrap();
    vector.resize(HUGE_PAGE);
    assert!(vector.iter().all(|&element| element == 0.0));
    assert_eq!(vector.as_ptr().addr() % 64, 0);
}

#[test]
#[should_panic(expected = "3 elements, capacity for 2")]
fn elements_need_capacity() {
    let mut vector = AlignedVec::new();
    vector.reserve(2).unwrap();
    vector.resize(3);
}
