//! From camera frames and an instruction to what a backbone takes, as the released processors prepare it.

mod files;
mod flexible;
mod frames;
mod options;
mod prompt;
mod python_text;
mod settings;
mod source;
mod tokenizer;
mod view;

use saccade_vla_kernels::Isa;

use crate::alloc::{filled, product, reserve};
use crate::array::OwnedArray;
use crate::error::{Error, Result, bail, ensure, problem};
use crate::parallel::in_parallel;
use crate::release::{Pixels, Preprocessing, Version, ViewRules, choice};
use prompt::{SpecialIds, prompt};
use settings::{Settings, Sizes};
use tokenizer::check_length;
use view::view;

pub use frames::{Frame, View};
pub use settings::ProcessorOptions;
pub use source::ProcessorSource;
pub use tokenizer::{Tokenizer, TokenizerFiles};

/// What a robot sees and is told at one time.
#[derive(Clone, Debug, Default)]
pub struct Observation<'a> {
    /// The frame of each camera, and the camera's name where it has one.
    pub views: Vec<(Option<&'a str>, Frame<'a>)>,
    /// Whether the views stand in the order of the prompt, also where the preprocessing would sort them by
    /// name.
    pub is_ordered: bool,
    /// What the robot is to do. Without it the released default is taken, where there is one.
    pub instruction: Option<&'a str>,
    /// N1.5: whether the instruction stands in the prompt as it is, even if the processor renders
    /// instructions as lists.
    pub plain_text: bool,
}

/// Inputs of a backbone, of a batch of observations.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Prepared {
    /// N1.5: one array `(batch * views, 3, height, width)`. N1.6: an array `(1, 3, height, width)` for each
    /// view. N1.7: one array
    /// `(patches, 1536)`.
    pub pixel_values: Vec<OwnedArray>,
    /// The tokens `(batch, length)`, padded on the left.
    pub input_ids: OwnedArray<i64>,
    /// `(batch, length)`: false where `input_ids` is padding.
    pub attention_mask: OwnedArray<bool>,
    /// N1.7: the grid of patches of every view, `(batch * views, 3)`: time, height, width.
    pub image_grid_thw: Option<OwnedArray<i64>>,
    /// The names of the views in the order of the prompt, where they have names.
    pub view_names: Option<Vec<String>>,
}

/// Prepares frames and instructions for the backbone of one version.
///
/// It is immutable: any number of threads may use it at the same time.
pub struct Processor {
    settings: Settings,
    tokenizer: Tokenizer,
    ids: SpecialIds,
    isa: Isa,
}

impl Processor {
    /// The processor of `version`, with the options of a checkpoint.
    ///
    /// # Errors
    /// [`Error::Input`] for N1, whose frames and words saccade does not prepare, and for options that are not
    /// the version's, all listed; [`Error::Checkpoint`] for a tokenizer without the version's special tokens;
    /// [`Error::Isa`] for an unknown instruction set in the environment.
    pub fn new(version: Version, tokenizer: Tokenizer, options: &ProcessorOptions<'_>) -> Result<Self> {
        let Some(rules) = &version.release().processor else {
            let known = choice(Version::all().filter(|version| version.release().processor.is_some()));
            bail!(Input, "version"; expected "{known}"; got "{:?}", version.name());
        };
        let settings = Settings::new(version, rules, options)?;
        let ids = SpecialIds::find(&tokenizer, version, &rules.prompt)?;
        Ok(Self {
            settings,
            ids,
            tokenizer,
            isa: Isa::from_env()?,
        })
    }

    /// The version whose frames and words it prepares.
    #[must_use]
    pub fn version(&self) -> Version {
        self.settings.version
    }

    /// Whose frames and words it prepares.
    #[must_use]
    pub fn preprocessing(&self) -> Preprocessing {
        self.settings.preprocessing
    }

    /// Height and width of the views, and their image tokens; none for N1.6 and N1.7, where they depend on
    /// the frame.
    #[must_use]
    pub fn view_size(&self) -> Option<(usize, usize)> {
        match self.settings.sizes {
            Sizes::Square { size, tokens, .. } => Some((size, tokens)),
            Sizes::Flexible(_) => None,
        }
    }

    /// Number of tokens of the tokenizer.
    #[must_use]
    pub fn num_tokens(&self) -> usize {
        self.tokenizer.len()
    }

    /// The id that stands for a token of an image.
    #[must_use]
    pub fn image_token_id(&self) -> u32 {
        self.ids.image
    }

    /// The view that a frame becomes.
    ///
    /// # Errors
    /// [`Error::Shape`] and [`Error::Input`] for a frame that is none; [`Error::Memory`].
    pub fn view(&self, frame: Frame<'_>) -> Result<View> {
        view(&self.settings, self.isa, "image", frame)
    }

    /// The ids of plain text.
    ///
    /// # Errors
    /// [`Error::Input`] for text that is too long for any model.
    pub fn tokens(&self, text: &str) -> Result<Vec<u32>> {
        self.tokenizer.encode(text)
    }

    /// The text of each of these tokens.
    ///
    /// # Errors
    /// [`Error::Input`] for an id that is no token's.
    pub fn texts(&self, ids: &[i64]) -> Result<Vec<String>> {
        let text = |&id: &i64| {
            let found = u32::try_from(id).ok().and_then(|id| self.tokenizer.text_of(id));
            found.ok_or_else(|| {
                Error::Input(problem!(
                    "ids"; expected "those of the tokenizer's {} tokens", self.num_tokens(); got "{id}"
                ))
            })
        };
        ids.iter().map(text).collect()
    }

    /// The inputs of a batch of observations.
    ///
    /// ```
    /// use saccade_vla::{Array, Frame, Observation, ProcessorSource};
    /// let processor = ProcessorSource::open("examples/tiny".as_ref())?.processor(None, None, None)?;
    /// let pixels = vec![128; 48 * 64 * 3];
    /// let frame = Frame::U8(Array::new(&pixels, &[48, 64, 3])?);
    /// let observation = Observation {
    ///     views: vec![(Some("front"), frame)],
    ///     instruction: Some("open the drawer"),
    ///     ..Observation::default()
    /// };
    /// let prepared = processor.process(&[observation])?;
    /// assert_eq!(prepared.pixel_values[0].shape(), [1, 3, 56, 56]);
    /// assert_eq!(prepared.input_ids.shape()[0], 1);
    /// # Ok::<(), saccade_vla::Error>(())
    /// ```
    ///
    /// # Errors
    /// [`Error::Shape`] and [`Error::Input`] for frames that are none, for observations with different views,
    /// and for an instruction that is too long or that changes the number of image tokens; [`Error::Memory`].
    pub fn process(&self, observations: &[Observation<'_>]) -> Result<Prepared> {
        let orders = self.orders(observations)?;
        let views = self.views(1, observations, &orders)?;
        self.prepared(observations, &orders, views)
    }

    /// The inputs of each observation, a batch of one each. Their frames are prepared on up to `threads` threads.
    ///
    /// # Errors
    /// Those of [`process`](Self::process), of frames before those of instructions.
    pub(crate) fn process_each(
        &self,
        threads: usize,
        observations: &[Observation<'_>],
    ) -> Result<Vec<Prepared>> {
        let alone = || observations.iter().map(std::slice::from_ref);
        let orders = alone().map(|one| self.orders(one)).collect::<Result<Vec<_>>>()?;
        let orders = orders.concat();
        let mut views = self.views(threads, observations, &orders)?.into_iter();
        alone()
            .zip(&orders)
            .map(|(one, order)| {
                let views = views.by_ref().take(order.len()).collect();
                self.prepared(one, std::slice::from_ref(order), views)
            })
            .collect()
    }

    /// The views of all observations in their orders, one observation after the other.
    fn views(
        &self,
        threads: usize,
        observations: &[Observation<'_>],
        orders: &[Vec<usize>],
    ) -> Result<Vec<View>> {
        let frames: Vec<_> = observations
            .iter()
            .zip(orders)
            .flat_map(|(observation, order)| order.iter().map(|&index| (index, observation.views[index])))
            .collect();
        in_parallel(threads, frames.len(), |task| {
            let (index, (name, frame)) = frames[task];
            let name = name.map_or_else(|| format!("frames[{index}]"), |name| format!("frames['{name}']"));
            view(&self.settings, self.isa, &name, frame)
        })
    }

    /// A batch of observations whose `views` stand one observation after the other, in their orders.
    fn prepared(
        &self,
        observations: &[Observation<'_>],
        orders: &[Vec<usize>],
        views: Vec<View>,
    ) -> Result<Prepared> {
        let view_names = orders.first().and_then(|order| names(&observations[0], order));
        let mut prompts = Vec::with_capacity(observations.len());
        let mut rest = &views[..];
        for (observation, order) in observations.iter().zip(orders) {
            let (seen, others) = rest.split_at(order.len());
            let tokens: Vec<usize> = seen.iter().map(|view| view.tokens).collect();
            prompts.push(self.prompt_ids(observation, &tokens)?);
            rest = others;
        }
        let (input_ids, attention_mask) = self.padded(&prompts)?;
        let grids: Vec<[i64; 3]> = views.iter().filter_map(|view| view.grid).collect();
        let image_grid_thw = match grids.is_empty() {
            true => None,
            false => Some(OwnedArray::new(grids.concat(), &[grids.len(), 3])?),
        };
        Ok(Prepared {
            pixel_values: self.joined(views)?,
            input_ids,
            attention_mask,
            image_grid_thw,
            view_names,
        })
    }

    /// The order in which the views of each observation stand.
    fn orders(&self, observations: &[Observation<'_>]) -> Result<Vec<Vec<usize>>> {
        let Some(first) = observations.first() else {
            bail!(Input, "frames"; expected "at least one observation"; got "none");
        };
        let mut orders: Vec<Vec<usize>> = Vec::with_capacity(observations.len());
        for observation in observations {
            let views = &observation.views;
            ensure!(!views.is_empty(), Input, "frames"; expected "at least one view"; got "none");
            let mut order: Vec<usize> = (0..views.len()).collect();
            if self.settings.preprocessing == Preprocessing::Lerobot && !observation.is_ordered {
                order.sort_by_key(|&index| views[index].0);
            }
            if let Some(expected) = orders.first() {
                let (expected, got) = (names(first, expected), names(observation, &order));
                ensure!(
                    views.len() == first.views.len() && expected == got, Input, "frames";
                    expected "the same views in every observation";
                    got "{} and {}", show_views(first, expected), show_views(observation, got)
                );
            }
            orders.push(order);
        }
        Ok(orders)
    }

    /// The ids of a prompt.
    fn prompt_ids(&self, observation: &Observation<'_>, views: &[usize]) -> Result<Vec<u32>> {
        let most = self.settings.rules.max_positions;
        let expected = views
            .iter()
            .fold(0_usize, |sum, tokens| sum.saturating_add(*tokens));
        ensure!(
            expected <= most, Input, "frames";
            expected "at most {most} image tokens"; got "{expected} in {} views", views.len()
        );
        check_length("instruction", observation.instruction.unwrap_or_default())?;
        // A run of image tokens is tokenized as one of them, and then repeated.
        let once = self.ids.image_stands_alone;
        let written = |tokens: &usize| if once { 1.min(*tokens) } else { *tokens };
        let written: Vec<usize> = views.iter().map(written).collect();
        let text = prompt(
            &self.settings,
            observation.instruction,
            observation.plain_text,
            &written,
        )?;
        let mut ids = self.tokenizer.ids("instruction", &text)?;
        let found = ids.iter().filter(|id| **id == self.ids.image).count();
        let written = written.iter().sum();
        ensure!(
            found == written, Input, "instruction";
            expected "no token that stands for an image"; got "{} of them", found.saturating_sub(written)
        );
        if once {
            let mut runs = views.iter().filter(|tokens| **tokens > 0);
            let mut repeated = Vec::new();
            reserve("input_ids", &mut repeated, ids.len() - found + expected)?;
            for id in ids {
                let run = if id == self.ids.image { runs.next() } else { None };
                repeated.extend(std::iter::repeat_n(id, run.copied().unwrap_or(1)));
            }
            ids = repeated;
        }
        ensure!(
            ids.len() <= most, Input, "instruction";
            expected "a prompt of at most {most} tokens"; got "{} with its {expected} image tokens", ids.len()
        );
        Ok(ids)
    }

    /// Ids and mask, filled up on the left to the longest prompt.
    fn padded(&self, prompts: &[Vec<u32>]) -> Result<(OwnedArray<i64>, OwnedArray<bool>)> {
        const WHAT: &str = "input_ids";
        let length = prompts.iter().map(Vec::len).max().unwrap_or(0);
        let len = product(WHAT, &[prompts.len(), length])?;
        let mut ids = filled(WHAT, len, i64::from(self.ids.padding))?;
        let mut mask = filled(WHAT, len, false)?;
        for (row, prompt) in prompts.iter().enumerate() {
            let end = (row + 1) * length;
            let start = end - prompt.len();
            for (to, &id) in ids[start..end].iter_mut().zip(prompt) {
                *to = i64::from(id);
            }
            mask[start..end].fill(true);
        }
        let shape = [prompts.len(), length];
        Ok((OwnedArray::new(ids, &shape)?, OwnedArray::new(mask, &shape)?))
    }

    /// The views in the arrays that the backbone takes.
    fn joined(&self, views: Vec<View>) -> Result<Vec<OwnedArray>> {
        let Some(first) = views.first() else {
            return Ok(Vec::new());
        };
        let (rows, mut shape) = match &self.settings.rules.views {
            ViewRules::Square { .. } => (views.len(), [&[0], first.pixels.shape()].concat()),
            ViewRules::Flexible(rules) if rules.pixels == Pixels::Planes => {
                return Ok(views.into_iter().map(|view| view.pixels).collect());
            }
            ViewRules::Flexible(_) => (
                views.iter().map(|view| view.pixels.shape()[0]).sum(),
                first.pixels.shape().to_vec(),
            ),
        };
        shape[0] = rows;
        let mut views = views.into_iter().map(|view| view.pixels);
        let (mut pixels, _) = views.next().map(OwnedArray::into_parts).unwrap_or_default();
        reserve("pixel_values", &mut pixels, product("pixel_values", &shape)?)?;
        for view in views {
            pixels.extend_from_slice(view.data());
        }
        Ok(vec![OwnedArray::new(pixels, &shape)?])
    }
}

/// The names of the views in this order, if every view has one.
fn names(observation: &Observation<'_>, order: &[usize]) -> Option<Vec<String>> {
    let name = |&index: &usize| observation.views[index].0.map(str::to_owned);
    order.iter().map(name).collect()
}

fn show_views(observation: &Observation<'_>, names: Option<Vec<String>>) -> String {
    match names {
        Some(names) => names.join(", "),
        None => format!("{} views", observation.views.len()),
    }
}
