//! The views of rows and of matrices.

use saccade_vla_kernels::{Matrix, Rows, RowsMut};

fn counted(len: usize) -> Vec<u32> {
    (0..).take(len).collect()
}

#[test]
fn parts_of_rows_are_where_they_should_be() {
    let mut data = counted(23);
    let x = Rows::strided(&data, 4, 5, 6);
    assert_eq!((x.num_rows(), x.num_columns(), x.row_stride()), (4, 5, 6));
    assert_eq!(x.rows(1..3).columns(2..4).row(1), [14, 15]);
    assert_eq!(x.columns(4..5).rows(3..4).row(0), [22]);
    assert_eq!(x.rows(4..4).num_rows(), 0);
    assert_eq!(x.columns(5..5).row(3), [0_u32; 0]);
    let mut out = RowsMut::strided(&mut data, 4, 5, 6);
    out.reborrow().rows(1..2).columns(1..3).row_mut(0).fill(100);
    assert_eq!(out.as_rows().row(1), [6, 100, 100, 9, 10]);
}

#[test]
fn rows_are_visited_copied_and_filled_without_what_is_between_them() {
    let (source, mut data) = (counted(8), vec![100; 11]);
    let x = Rows::strided(&source, 3, 2, 3);
    assert_eq!(x.iter().collect::<Vec<_>>(), [[0, 1], [3, 4], [6, 7]]);
    let mut out = RowsMut::strided(&mut data, 3, 2, 4);
    out.copy_from(x);
    out.reborrow().rows(1..2).fill(9);
    assert_eq!(data, [0, 1, 100, 100, 9, 9, 100, 100, 6, 7, 100]);
    let mut one = RowsMut::strided(&mut data, 1, 2, 0);
    assert_eq!(one.iter_mut().count(), 1);
    let mut empty = RowsMut::strided(&mut data, 3, 0, 0);
    assert!(empty.iter_mut().len() == 3 && empty.iter_mut().all(|row| row.is_empty()));
}

#[test]
fn contiguous_rows_are_joined() {
    let data = counted(13);
    let joined = Rows::strided(&data, 6, 2, 2).joined(3);
    assert_eq!((joined.num_rows(), joined.row(1)), (2, &[6, 7, 8, 9, 10, 11][..]));
}

#[test]
#[should_panic(expected = "expected contiguous rows, 2 in each")]
fn rows_that_are_apart_are_not_joined() {
    let _ = Rows::strided(&[0.0; 9], 2, 2, 3).joined(2);
}

#[test]
fn views_without_elements() {
    let none: [f32; 0] = [];
    assert_eq!(Rows::new(&none, 7).num_rows(), 0);
    assert_eq!(Rows::new(&none, 0).num_rows(), 0);
    for row_stride in [0, 5] {
        let x = Rows::strided(&none, 3, 0, row_stride);
        assert_eq!((x.num_rows(), x.row(2)), (3, &none[..]));
        assert_eq!(x.row_stride(), 0, "no pointer to a row leaves the data");
    }
}

#[test]
#[should_panic(expected = "data: expected whole rows of 4 elements")]
fn a_part_of_a_row_is_refused() {
    let _ = Rows::new(&[0.0; 7], 4);
}

#[test]
#[should_panic(expected = "data: expected room for 3 rows of 2 elements, 4 apart, got 9 elements")]
fn data_that_is_too_short_is_refused() {
    let _ = Rows::strided(&[0.0; 9], 3, 2, 4);
}

#[test]
#[should_panic(expected = "data: expected room")]
fn a_size_that_overflows_is_refused() {
    let _ = Rows::strided(&[0.0; 9], usize::MAX, 2, usize::MAX / 2);
}

#[test]
#[should_panic(expected = "row_stride: expected at least the 3 elements of a row, got 2")]
fn rows_to_write_that_overlap_are_refused() {
    let _ = RowsMut::strided(&mut [0.0; 9], 3, 3, 2);
}

#[test]
#[should_panic(expected = "rows 1..4 of 3")]
fn rows_that_are_not_there_are_refused() {
    let _ = Rows::new(&[0.0; 6], 2).rows(1..4);
}

#[test]
fn a_transposed_matrix_has_the_same_elements() {
    let data: Vec<u32> = (0..12).collect();
    let matrix = Matrix::new(&data, 4);
    let turned = matrix.transpose();
    assert_eq!((turned.num_rows(), turned.num_columns()), (4, 3));
    for (row, column) in (0..3).flat_map(|row| (0..4).map(move |column| (row, column))) {
        assert_eq!(matrix.get(row, column), turned.get(column, row));
    }
    assert_eq!(turned.rows(1..3).columns(2..3).get(1, 0), matrix.get(2, 2));
    assert_eq!(matrix.contiguous_row(1), Some(&data[4..8]));
    assert_eq!(turned.contiguous_row(1), None);
}

#[test]
fn a_matrix_without_columns_has_rows() {
    let none: [f32; 0] = [];
    let matrix = Matrix::from(Rows::strided(&none, 3, 0, 0));
    assert_eq!(matrix.transpose().num_columns(), 3);
    assert_eq!(matrix.rows(2..3).contiguous_row(0), Some(&none[..]));
}
