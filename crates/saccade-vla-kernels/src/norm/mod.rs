//! Norms of rows: LayerNorm and RMSNorm.

pub(crate) mod layer;
pub(crate) mod rms;

/// Elements from which a second thread pays: below, one core is done in less time than it takes to wake another.
const ELEMENTS_FOR_THREADS: usize = 1 << 16;

/// Elements of one task: long enough that dealing it costs nothing, short enough that threads finish together.
const ELEMENTS_PER_TASK: usize = 1 << 13;

/// How many threads and tasks a norm of `rows` rows of `width` elements gets.
fn split(threads: usize, rows: usize, width: usize) -> (usize, usize) {
    let elements = rows.saturating_mul(width);
    let tasks = elements.div_ceil(ELEMENTS_PER_TASK).min(rows);
    let threads = if elements < ELEMENTS_FOR_THREADS {
        1
    } else {
        threads
    };
    (threads, tasks)
}
