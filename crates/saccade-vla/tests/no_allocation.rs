//! Sampling allocates nothing after the first call of a shape.

mod common;

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};

use common::{Inputs, released};
use saccade_vla::{Array, ArrayMut, Chunking, Guidance, Sampling};

struct Counting;

static ALLOCATIONS: AtomicUsize = AtomicUsize::new(0);

// SAFETY: the system's allocator, with a counter beside it.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's promise is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's promise is passed on.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn the_second_sample_of_a_shape_allocates_nothing() {
    // The three kinds of head, and threads: none is like another to the code that runs.
    for (name, threads) in [
        ("n15_single_view.safetensors", 1),
        ("n15_single_view.safetensors", 2),
        ("n17_tiny.safetensors", 2),
        ("fork_two_decoders.safetensors", 2),
    ] {
        let head = released(name, threads);
        let config = head.config();
        let (horizon, width) = (config.action_horizon, config.encoder_action_dim);
        let context = Inputs::new(&head, &[1, 3], 50).context;
        let without = Inputs::new(&head, &[1, 3], 45).context;
        let (state, noise) = (
            vec![0.2; 2 * config.state_dim],
            vec![0.3; 2 * 3 * horizon * width],
        );
        let previous_chunk = vec![0.4; 2 * horizon * width];
        let shape = [2, horizon, width];
        let mut out = vec![0.0; 2 * 3 * horizon * config.action_dim];
        let mut sample = |future_refresh: Option<usize>, is_chunked: bool, is_guided: bool| {
            let chunking = Chunking {
                previous_chunk: Array::new(&previous_chunk, &shape).unwrap(),
                overlap: 4,
                frozen: 1,
                ramp_rate: 6.0,
                horizon: None,
            };
            let sampling = Sampling {
                num_samples: Some(3),
                future_refresh,
                chunking: is_chunked.then_some(chunking),
                guidance: is_guided.then_some(Guidance {
                    without: &without,
                    weight: 2.0,
                }),
                ..Sampling::default()
            };
            head.sample(
                &context,
                Array::new(&state, &[2, config.state_dim]).unwrap(),
                Array::new(&[1, 3], &[2]).unwrap(),
                Array::new(&noise, &[2, 3, horizon, width]).unwrap(),
                &sampling,
                ArrayMut::new(&mut out, &[2, 3, horizon, config.action_dim]).unwrap(),
            )
            .unwrap();
        };
        for (future_refresh, is_chunked, is_guided) in [
            (None, false, false),
            (Some(3), true, false),
            (Some(2), true, true),
        ] {
            sample(future_refresh, is_chunked, is_guided);
            let before = ALLOCATIONS.load(Ordering::Relaxed);
            sample(future_refresh, is_chunked, is_guided);
            assert_eq!(
                ALLOCATIONS.load(Ordering::Relaxed),
                before,
                "{name}, {threads} threads, future_refresh {future_refresh:?}"
            );
        }
    }
}
