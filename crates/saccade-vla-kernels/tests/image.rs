//! Images: parts of them, and the same bits of every resize on every instruction set.

mod common;

use common::isas;
use saccade_vla_kernels::{
    Image, Isa, WeightRounding, resize_area, resize_cubic_u8, resize_linear_f32, resize_linear_u8,
};

#[test]
fn crops_are_views_of_the_same_pixels() {
    let pixels: Vec<u8> = (0..60).collect();
    let part = Image::new(&pixels, 4, 5).crop(1, 2, 2, 3);
    assert_eq!(part.row(0), &pixels[21..30]);
    let rows = [&pixels[21..30], &pixels[36..45]].concat();
    assert_eq!(part.to_vec().unwrap(), rows);
}

#[test]
fn every_instruction_set_resizes_to_the_same_bits() {
    let noise = common::numbers(1, 97 * 131 * 3, 128.0);
    let pixels: Vec<u8> = noise.iter().map(|value| (value + 128.0) as u8).collect();
    let image = Image::new(&pixels, 97, 131);
    let all = |isa: Isa, image: Image<'_>, height, width| {
        (
            resize_area(isa, image, height, width).unwrap(),
            resize_linear_u8(isa, image, height, width).unwrap(),
            [WeightRounding::Torch, WeightRounding::Pillow]
                .map(|rule| resize_cubic_u8(isa, image, height, width, rule).unwrap()),
            resize_linear_f32(isa, image, height, width).unwrap(),
        )
    };
    for (image, height, width) in [
        (image, 64, 86),
        (image, 97, 50),
        (image, 200, 131),
        (image.crop(3, 5, 60, 61), 33, 99),
    ] {
        let expected = all(Isa::Portable, image, height, width);
        for isa in isas() {
            assert!(
                all(isa, image, height, width) == expected,
                "{isa}: {height} x {width}"
            );
        }
    }
}
