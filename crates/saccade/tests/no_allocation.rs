//! Sampling allocates nothing after the first call of a shape.

use std::alloc::{GlobalAlloc, Layout, System};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use saccade::{ActionHead, Array, Features, LoadOptions, Sampling};

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
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/n15_single_view.safetensors");
    let bytes = std::fs::read(&path).unwrap();
    let size = usize::try_from(u64::from_le_bytes(bytes[..8].try_into().unwrap())).unwrap();
    let header: serde_json::Value = serde_json::from_slice(&bytes[8..8 + size]).unwrap();
    let config = header["__metadata__"]["config"].as_str().unwrap().to_owned();
    for threads in [1, 2] {
        let options = LoadOptions {
            config: Some(config.clone()),
            num_threads: Some(threads),
            ..Default::default()
        };
        let head = ActionHead::load(&path, &options).unwrap();
        let features = vec![0.1; 2 * 50 * 128];
        let context = head
            .encode(&Features::new(Array::new(&features, &[2, 50, 128])))
            .unwrap();
        let (state, noise) = (vec![0.2; 2 * 64], vec![0.3; 2 * 3 * 16 * 32]);
        let mut out = vec![0.0; noise.len()];
        let mut sample = |future_refresh| {
            head.sample(
                &context,
                Array::new(&state, &[2, 64]),
                Array::new(&[1, 3], &[2]),
                Array::new(&noise, &[2, 3, 16, 32]),
                &Sampling {
                    num_samples: Some(3),
                    future_refresh,
                    ..Default::default()
                },
                &mut out,
            )
            .unwrap();
        };
        for future_refresh in [None, Some(3)] {
            sample(future_refresh);
            let before = ALLOCATIONS.load(Ordering::Relaxed);
            sample(future_refresh);
            assert_eq!(
                ALLOCATIONS.load(Ordering::Relaxed),
                before,
                "{threads} threads, future_refresh {future_refresh:?}"
            );
        }
    }
}
