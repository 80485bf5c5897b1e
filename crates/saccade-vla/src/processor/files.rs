//! The options of a processor in the files beside a checkpoint: Isaac-GR00T's, and lerobot's saved steps.

use std::path::Path;

use saccade_vla_checkpoint::read_text;
use serde_json::{Value, json};

use super::options::{asks_for_nothing, is_argument, is_read};
use super::settings::{LEROBOT_CROP, LEROBOT_TARGET, Preprocessing};
use crate::config::{Object, Version};
use crate::error::{Error, Result, problem};

const PROCESSOR: &str = "processor_config.json";
const PIPELINE: &str = "policy_preprocessor.json";

/// Steps of lerobot's preprocessors that decide about frames and words, and the keys of their configs.
const STEPS: [(&str, &[&str]); 5] = [
    (
        "groot_pack_inputs_v3",
        &[
            "action_horizon",
            "embodiment_mapping",
            "embodiment_tag",
            "formalize_language",
            "language_key",
            "max_action_dim",
            "max_state_dim",
            "normalize_min_max",
            "state_horizon",
        ],
    ),
    ("groot_eagle_encode_v3", &["tokenizer_assets_repo"]),
    ("groot_eagle_collate_v3", &["tokenizer_assets_repo"]),
    (
        "groot_n1_7_pack_inputs_v1",
        &[
            "action_horizon",
            "clip_outliers",
            "embodiment_mapping",
            "embodiment_tag",
            "formalize_language",
            "language_key",
            "max_action_dim",
            "max_state_dim",
            "modality_config",
            "normalize_min_max",
            "raw_stats",
            "state_dropout_prob",
            "state_horizon",
            "training",
            "use_percentiles",
            "valid_action_horizon",
            "video_horizon",
            "video_modality_keys",
        ],
    ),
    (
        N17_ENCODE,
        &[
            "crop_fraction",
            "device",
            "image_crop_size",
            "image_target_size",
            "letter_box_transform",
            "model_name",
            "shortest_image_edge",
            "training",
            "use_albumentations",
        ],
    ),
];

const N17_ENCODE: &str = "groot_n1_7_vlm_encode_v1";

/// Steps that leave frames and words as they are.
const OTHER_STEPS: [&str; 5] = [
    "delta_actions_processor",
    "device_processor",
    "relative_actions_processor",
    "rename_observations_processor",
    "to_batch_processor",
];

/// The options in the files of a checkpoint that are read here.
///
/// # Errors
/// [`Error::Checkpoint`] and [`Error::Json`] for files that are broken, and for keys and steps that their release does not know.
pub(super) fn options(version: Version, preprocessing: Preprocessing, directory: &Path) -> Result<Object> {
    let mut options = match (preprocessing, version) {
        (Preprocessing::Isaac, Version::N16 | Version::N17) => isaac(version, directory)?,
        (Preprocessing::Isaac, _) => Object::new(),
        (Preprocessing::Lerobot, _) => lerobot(version, directory)?,
    };
    options.retain(|key, _| is_read(version, key));
    if version == Version::N17 {
        add_pixel_limits(&mut options, directory)?;
    }
    Ok(options)
}

/// Adds the least and the greatest area that the `preprocessor_config.json` in `folder` has, if they are not there yet.
///
/// # Errors
/// [`Error::Checkpoint`] and [`Error::Json`] for a file that is broken.
pub(super) fn add_pixel_limits(options: &mut Object, folder: &Path) -> Result<()> {
    let Some(file) = read_object("source", &folder.join("preprocessor_config.json"))? else {
        return Ok(());
    };
    for (key, value) in file {
        if ["min_pixels", "max_pixels", "size"].contains(&key.as_str()) {
            options.entry(key).or_insert(value);
        }
    }
    Ok(())
}

/// What the file of Isaac-GR00T's processor says; nothing where there is none.
fn isaac(version: Version, directory: &Path) -> Result<Object> {
    let Some(mut kwargs) = processor_kwargs(version, directory)? else {
        return Ok(Object::new());
    };
    // The default of the released constructors.
    kwargs.entry("use_albumentations").or_insert(json!(false));
    Ok(kwargs)
}

/// The `processor_kwargs` of a checkpoint of N1.6 or N1.7: in the folder itself, and where that has none in `processor/`, which is where
/// training leaves them.
fn processor_kwargs(version: Version, directory: &Path) -> Result<Option<Object>> {
    for folder in ["", "processor"] {
        let path = directory.join(folder).join(PROCESSOR);
        let Some(mut file) = read_object("source", &path)? else {
            continue;
        };
        let mut kwargs = match file.remove("processor_kwargs") {
            Some(Value::Object(kwargs)) => kwargs,
            Some(_) => return refused(&path, "processor_kwargs: expected an object"),
            // Another program's file of this name holds nothing of it.
            None => continue,
        };
        let released = match version {
            Version::N16 => "Gr00tN1d6Processor",
            _ => "Gr00tN1d7Processor",
        };
        if let Some(class) = file.get("processor_class").filter(|class| !class.is_null())
            && class != released
        {
            let what = format!(
                "processor_class: expected {released}, since the tensors are those of {}, got {class}",
                version.title()
            );
            return refused(&path, &what);
        }
        check_keys(&path, "processor_kwargs", &kwargs, &|key| {
            is_argument(version, key)
        })?;
        // What another version calls by this name says nothing here, also where it is false.
        kwargs.retain(|key, _| is_argument(version, key));
        return Ok(Some(kwargs));
    }
    Ok(None)
}

/// What lerobot's saved steps say. Without them: what lerobot makes of a raw checkpoint.
fn lerobot(version: Version, directory: &Path) -> Result<Object> {
    let path = directory.join(PIPELINE);
    let steps = match read_object("source", &path)?.map(|mut file| file.remove("steps")) {
        None if version == Version::N17 => {
            return Ok(as_lerobot_writes(
                processor_kwargs(version, directory)?.unwrap_or_default(),
            ));
        }
        None => return Ok(Object::new()),
        Some(Some(Value::Array(steps))) => steps,
        Some(_) => return refused(&path, "steps: expected a list"),
    };
    let mut options = match version {
        Version::N17 => as_lerobot_writes(Object::new()),
        _ => Object::new(),
    };
    for (index, step) in steps.iter().enumerate() {
        let name = ["registry_name", "class"]
            .iter()
            .find_map(|key| step.get(key)?.as_str());
        let nothing = Object::new();
        let config = match step.get("config") {
            None | Some(Value::Null) => &nothing,
            Some(Value::Object(config)) => config,
            Some(_) => return refused(&path, &format!("steps[{index}].config: expected an object")),
        };
        let found = STEPS.iter().find(|(known, _)| name == Some(known));
        let Some((name, keys)) = found else {
            let is_off = config.get("enabled") == Some(&Value::Bool(false));
            if is_off || name.is_some_and(|name| OTHER_STEPS.contains(&name)) {
                continue;
            }
            let known: Vec<&str> = STEPS.iter().map(|(name, _)| *name).chain(OTHER_STEPS).collect();
            let name = name.unwrap_or("a step without a name");
            let what = format!("steps[{index}]: expected one of {}, got {name}", known.join(", "));
            return refused(&path, &what);
        };
        check_keys(&path, name, config, &|key| keys.contains(&key))?;
        if *name == N17_ENCODE {
            // Whatever the step leaves out has the default of its class.
            options.extend(object(json!({
                "crop_fraction": null,
                "image_crop_size": null,
                "image_target_size": null,
                "letter_box_transform": false,
                "shortest_image_edge": null,
                "use_albumentations": false,
            })));
        }
        options.extend(config.clone());
    }
    Ok(options)
}

/// What lerobot writes into its steps for an NVIDIA checkpoint of N1.7 with these options.
fn as_lerobot_writes(mut kwargs: Object) -> Object {
    // Sizes of a checkpoint count if it has a target.
    if kwargs.get("image_target_size").is_none_or(Value::is_null) {
        kwargs.extend(object(json!({
            "crop_fraction": null,
            "image_crop_size": LEROBOT_CROP,
            "image_target_size": LEROBOT_TARGET,
            "shortest_image_edge": null,
        })));
    }
    kwargs
}

/// That a config has keys only that its release knows. Others are options that cannot be used, like those with a value that cannot.
fn check_keys(path: &Path, owner: &str, config: &Object, is_known: &dyn Fn(&str) -> bool) -> Result<()> {
    let unknown = config
        .iter()
        .filter(|(key, value)| !is_known(key) && !asks_for_nothing(value));
    let unknown: Vec<&str> = unknown.map(|(key, _)| key.as_str()).collect();
    if unknown.is_empty() {
        return Ok(());
    }
    Err(Error::Input(problem!(
        "source"; "{}: {owner}: {}: expected none: its release has no such option",
        path.display(), unknown.join(", ")
    )))
}

fn refused<T>(path: &Path, what: &str) -> Result<T> {
    Err(Error::Checkpoint(problem!(
        "source"; "{}: {what}", path.display()
    )))
}

/// The keys of an object; none of anything else.
fn object(value: Value) -> Object {
    match value {
        Value::Object(keys) => keys,
        _ => Object::new(),
    }
}

/// The object in a JSON file, if the file is there.
///
/// # Errors
/// [`Error::File`], [`Error::Json`] and [`Error::Checkpoint`] for a file that is no such thing.
pub(super) fn read_object(what: &'static str, path: &Path) -> Result<Option<Object>> {
    if !path.exists() {
        return Ok(None);
    }
    let text = read_text(what, path)?;
    match serde_json::from_str(&text) {
        Ok(Value::Object(keys)) => Ok(Some(keys)),
        Ok(_) => Err(Error::Checkpoint(problem!(
            what; "{}: expected a JSON object", path.display()
        ))),
        Err(source) => Err(Error::Json {
            what: format!("{what}: {}", path.display()),
            source: source.into(),
        }),
    }
}
