//! Contenders that take turns.

use std::time::{Duration, Instant};

use rustix::time::{ClockId, clock_gettime};

use saccade_vla_kernels::peak::multiply_accumulate;
use saccade_vla_kernels::{Arithmetic, Isa};

use crate::options::{Clock, Options};

/// The unit of rates whose work is multiply-accumulates.
pub const MULTIPLY_ACCUMULATES: &str = "1e9 multiply-accumulates";

/// Something to time.
pub struct Contender<'a> {
    /// Its name in the table.
    pub name: String,
    /// How many threads it uses.
    pub threads: usize,
    /// Multiply-accumulates, or other units of work, of one call.
    pub work: f64,
    /// Name of the contender that its rate is divided by.
    pub relative_to: Option<String>,
    /// One call.
    pub run: Box<dyn FnMut() + 'a>,
}

impl<'a> Contender<'a> {
    /// One without a base, on one thread.
    pub fn new(name: impl Into<String>, work: f64, run: impl FnMut() + 'a) -> Self {
        Self {
            name: name.into(),
            threads: 1,
            work,
            relative_to: None,
            run: Box::new(run),
        }
    }
}

impl Contender<'_> {
    /// The most that the instructions of `isa` and `arithmetic` can do.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "a count of operations")]
    pub fn peak(isa: Isa, arithmetic: Arithmetic, threads: usize) -> Self {
        let run = |isa, arithmetic, threads| {
            multiply_accumulate(isa, arithmetic, threads).expect("the threads can be started")
        };
        Self {
            name: Self::peak_name(isa, arithmetic),
            threads,
            work: run(isa, arithmetic, threads) as f64,
            relative_to: None,
            run: Box::new(move || {
                run(isa, arithmetic, threads);
            }),
        }
    }

    /// What [`Self::peak`] is called.
    #[must_use]
    pub fn peak_name(isa: Isa, arithmetic: Arithmetic) -> String {
        format!("peak {isa}, {}", arithmetic_name(arithmetic))
    }
}

/// As users spell it.
#[must_use]
pub fn arithmetic_name(arithmetic: Arithmetic) -> &'static str {
    match arithmetic {
        Arithmetic::Float32 => "float32",
        Arithmetic::Bfloat16 => "bfloat16",
        Arithmetic::Int8 => "int8",
        Arithmetic::Int4 => "int4",
    }
}

/// Rates of one contender, in `1e9` units of work a second, one a round.
#[derive(Clone, Debug)]
pub struct Rates {
    /// The contender's name.
    pub name: String,
    /// Its threads.
    pub threads: usize,
    /// One rate a round.
    pub rates: Vec<f64>,
    /// Rate over that of the contender it is relative to, in the same round.
    pub ratios: Vec<f64>,
}

/// A sample lasts at least this long: long against the clock's resolution, short against what disturbs a machine.
const SAMPLE: Duration = Duration::from_millis(5);

/// Runs all contenders in turn, `options.rounds` times, starting each round with another one.
#[must_use]
#[expect(clippy::cast_precision_loss, reason = "a handful of calls")]
pub fn measure(options: &Options, contenders: &mut [Contender<'_>]) -> Vec<Rates> {
    let calls: Vec<usize> = contenders
        .iter_mut()
        .map(|contender| calls_in_a_sample(contender))
        .collect();
    let mut rates = vec![Vec::with_capacity(options.rounds); contenders.len()];
    for round in 0..options.rounds {
        for turn in 0..contenders.len() {
            let index = (turn + round) % contenders.len();
            let contender = &mut contenders[index];
            let start = now(options.clock);
            for _ in 0..calls[index] {
                (contender.run)();
            }
            let seconds = (now(options.clock) - start).as_secs_f64();
            rates[index].push(contender.work * calls[index] as f64 / seconds * 1e-9);
        }
    }
    let ratios = |contender: &Contender<'_>, own: &[f64]| {
        let base = contender.relative_to.as_ref().and_then(|name| {
            contenders
                .iter()
                .position(|other| other.name == *name && other.threads == contender.threads)
        });
        base.map_or_else(Vec::new, |base| {
            own.iter()
                .zip(&rates[base])
                .map(|(own, base)| own / base)
                .collect()
        })
    };
    contenders
        .iter()
        .zip(&rates)
        .map(|(contender, own)| Rates {
            name: contender.name.clone(),
            threads: contender.threads,
            rates: own.clone(),
            ratios: ratios(contender, own),
        })
        .collect()
}

fn calls_in_a_sample(contender: &mut Contender<'_>) -> usize {
    (contender.run)();
    let start = Instant::now();
    (contender.run)();
    let once = start.elapsed().max(Duration::from_nanos(100));
    usize::try_from(SAMPLE.as_nanos().div_ceil(once.as_nanos()))
        .unwrap_or(1)
        .max(1)
}

fn now(clock: Clock) -> Duration {
    let id = match clock {
        Clock::Wall => ClockId::Monotonic,
        Clock::Processor => ClockId::ProcessCPUTime,
    };
    let time = clock_gettime(id);
    Duration::new(
        time.tv_sec.unsigned_abs(),
        u32::try_from(time.tv_nsec).unwrap_or(0),
    )
}

/// The value below which `part` of the samples are.
#[must_use]
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::cast_precision_loss,
    reason = "an index"
)]
pub fn quantile(samples: &[f64], part: f64) -> f64 {
    let mut sorted = samples.to_vec();
    sorted.sort_by(f64::total_cmp);
    match sorted.len() {
        0 => f64::NAN,
        len => sorted[((len - 1) as f64 * part).round() as usize],
    }
}
