//! Dense linear algebra of activations: ridge regression, principal components, similarity (equations 49 to 53
//! of docs/equations.md).
//!
//! Rows are observations, columns are features: `(rows, features)`. Everything is float64, computed by faer on
//! one thread: equal inputs give equal bits on the same CPU, whatever the number of threads.
//!
//! All but [`principal_angles`] subtract the mean of each column first. A column that varies by rounding alone
//! counts as constant: it becomes zero.
//!
//! ```
//! use saccade_vla::{Array, linalg};
//!
//! // Rows of a model, and a target that they hold linearly.
//! let rows = [0.0, 1.0, 1.0, 0.0, 2.0, 2.0, 3.0, 1.0];
//! let targets = [1.0, 2.0, 6.0, 7.0]; // 2 a + b
//! let (rows, targets) = (Array::new(&rows, &[4, 2])?, Array::new(&targets, &[4, 1])?);
//!
//! let ridge = linalg::Ridge::fit(rows, targets, &[0.0, 10.0])?;
//! let predicted = ridge.predict(rows)?; // (penalties, rows, targets)
//! assert_eq!(predicted.shape(), [2, 4, 1]);
//! assert!((predicted.data()[3] - 7.0).abs() < 1e-12);
//! assert!(predicted.data()[7] < 6.0, "the greater penalty draws it to the mean");
//!
//! // The same in standardised features, on one principal component.
//! let scaler = linalg::Standardizer::fit(rows)?;
//! let scaled = scaler.transform(rows)?;
//! let pca = linalg::Pca::fit(scaled.view(), 1)?;
//! assert_eq!(pca.transform(scaled.view())?.shape(), [4, 1]);
//!
//! assert!((linalg::linear_cka(rows, rows)? - 1.0).abs() < 1e-12);
//! # Ok::<(), saccade_vla::Error>(())
//! ```

mod angles;
mod cka;
mod matrix;
mod pca;
mod ridge;
mod standardizer;
mod svd;

pub use angles::principal_angles;
pub use cka::linear_cka;
pub use pca::Pca;
pub use ridge::Ridge;
pub use standardizer::Standardizer;
