//! Calls of a size before the first real one.

use super::action_head::ActionHead;
use super::encode::Features;
use super::sample::{Sampling, check_refresh};
use crate::alloc::{collected, filled, product};
use crate::array::{Array, ArrayMut};
use crate::config::Reads;
use crate::error::{Error, Result, ensure, problem};
use crate::sampling::timestep::timestep;

/// Elements of tokens and rows that a warm-up may ask for: 8 GB in float32, far above any batch that a CPU is
/// given.
const MAX_WARMUP_ELEMENTS: usize = 1 << 31;

impl ActionHead {
    /// Allocates and touches all that calls of this size need: weights, caches, buffers and threads.
    ///
    /// # Errors
    /// [`Error::Input`] for a size of zero, [`Error::Memory`] for one that does not fit in memory.
    pub fn warmup(
        &self,
        num_vl_tokens: usize,
        batch: usize,
        num_samples: Option<usize>,
        future_refresh: Option<usize>,
    ) -> Result<()> {
        check_refresh(future_refresh)?;
        for (name, size) in [
            ("num_vl_tokens", num_vl_tokens),
            ("batch", batch),
            ("num_samples", num_samples.unwrap_or(1)),
        ] {
            ensure!(size != 0, Input, name; expected "at least 1"; got "0");
        }
        self.check_warmup(num_vl_tokens, batch, num_samples.unwrap_or(1))?;
        let kinds = self.kinds();
        ensure!(
            kinds.len() <= num_vl_tokens, Input, "num_vl_tokens";
            expected "at least 2, one of text and one of an image"; got "{num_vl_tokens}"
        );
        let config = &self.config;
        let sizes = [batch, num_vl_tokens, config.context_dim];
        let features = filled("features", product("features", &sizes)?, 0.0)?;
        // Asked for before the observations are encoded, which takes long.
        let chunk = [config.action_horizon, config.encoder_action_dim];
        let shape: Vec<usize> = [batch].into_iter().chain(num_samples).chain(chunk).collect();
        let noise = filled("noise", product("noise", &shape)?, 0.0)?;
        let mut out_shape = shape.clone();
        out_shape[shape.len() - 1] = config.action_dim;
        let mut out = filled("actions", product("actions", &out_shape)?, 0.0)?;

        // One kind of block sees all but one token: no call of this size gathers more at a time.
        let is_image = |token: usize| kinds.contains(&Reads::Images) && !token.is_multiple_of(num_vl_tokens);
        let tokens = batch * num_vl_tokens;
        let image_mask = collected("masks", tokens, (0..tokens).map(is_image))?;
        let features = Features::new(Array::new(&features, &sizes)?);
        let image_mask = Some(Array::new(&image_mask, &sizes[..2])?);
        let context = self.encode(&Features {
            image_mask,
            ..features
        })?;
        let state_shape = [batch, config.num_states, config.state_dim];
        let state = filled("state", product("state", &state_shape)?, 0.0)?;
        for &id in &self.embodiment_ids {
            for step in 0..config.num_steps {
                let timestep = timestep(step, config.num_steps, config.num_timestep_buckets);
                self.layers.action_encoder.time_bias(self.engine, id, timestep)?;
            }
        }
        let embodiment_id = [self.embodiment_ids[0] as i64];
        self.sample(
            &context,
            Array::new(&state, &state_shape)?,
            Array::new(&embodiment_id, &[])?,
            Array::new(&noise, &shape)?,
            &Sampling {
                num_samples,
                future_refresh,
                ..Sampling::default()
            },
            ArrayMut::new(&mut out, &out_shape)?,
        )
    }

    /// Checks that the rows of such a call are not more than any call is given.
    fn check_warmup(&self, num_vl_tokens: usize, batch: usize, num_samples: usize) -> Result<()> {
        let config = &self.config;
        let rows = num_samples
            .checked_mul(config.num_rows())
            .and_then(|rows| rows.checked_mul(config.width));
        let tokens = num_vl_tokens.checked_mul(config.context_dim);
        let elements = rows
            .zip(tokens)
            .and_then(|(rows, tokens)| rows.checked_add(tokens)?.checked_mul(batch));
        match elements {
            Some(elements) if elements <= MAX_WARMUP_ELEMENTS => Ok(()),
            _ => Err(Error::Input(problem!(
                "num_vl_tokens, batch, num_samples"; expected "sizes whose rows fit in memory";
                got "{num_vl_tokens}, {batch}, {num_samples}"
            ))),
        }
    }
}
