"""Which tests prove what each kind of bad input gets: one row a kind.

`pytest tests/pipeline/test_bad_input.py -v` lists them; a row names its tests as file::function.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
from pathlib import Path

import numpy as np
import pytest
from judged import pair, verdict

TESTS = Path(__file__).parents[1]
ROWS: dict[int, tuple[str, str]] = {
    1: ("empty file", "io/test_front.py::test_an_empty_file_is_refused"),
    2: (
        "OBJ cut off in a face",
        "io/test_obj.py::test_malformed_files_are_refused_with_their_place",
    ),
    3: ("PLY cut off", "io/test_ply.py::test_every_truncation_of_a_binary_file_is_refused"),
    4: (
        "PLY count over its text",
        "io/test_ply.py::"
        "test_every_truncation_of_a_text_file_is_refused_or_loses_only_the_line_end "
        "io/test_ply.py::test_broken_text_is_refused_with_its_line",
    ),
    5: ("PLY count huge", "io/test_ply.py::test_counts_are_checked_before_memory_is_asked_for"),
    6: ("PLY format unknown", "io/test_ply.py::test_broken_headers_are_refused"),
    7: ("PLY mixed faces", "io/test_ply.py::test_mixed_triangles_quads_and_ngons"),
    8: (
        "PLY empty face",
        "io/test_ply.py::test_faces_without_vertices_are_dropped_and_counted",
    ),
    9: (
        "concave or bent polygon",
        "io/test_obj.py::test_a_concave_polygon_is_cut_inside "
        "io/test_ply.py::test_concave_faces_are_cut_through_the_notch "
        "io/test_polygons.py::test_dart_is_cut_through_its_notch_and_a_bent_one_is_told",
    ),
    10: ("OBJ quads", "io/test_obj.py::test_the_corners_of_polygons_keep_their_texture"),
    11: (
        "OBJ negative indices",
        "io/test_obj.py::test_negative_indices_count_from_where_they_stand",
    ),
    12: (
        "vertex index out of range",
        "io/test_obj.py::test_malformed_files_are_refused_with_their_place "
        "io/test_ply.py::test_indices_out_of_range_are_refused_with_the_face "
        "io/test_gltf.py::test_indices_out_of_range_are_refused_with_the_face",
    ),
    13: (
        "UV index out of range",
        "io/test_obj.py::test_a_texture_coordinate_out_of_range_is_refused_or_left_out "
        "io/test_ply.py::test_broken_texture_columns_are_refused_but_not_for_geometry",
    ),
    14: (
        "vertices not finite",
        "io/test_obj.py::test_vertices_that_are_no_numbers_take_their_faces_along "
        "io/test_ply.py::test_few_lost_vertices_go_with_their_faces_many_are_refused "
        "io/test_gltf.py::test_vertices_that_are_not_finite",
    ),
    15: (
        "degenerate and double faces",
        "io/test_obj.py::test_degenerate_and_repeated_faces_are_counted "
        "raster/test_drawing.py::test_degenerate_and_doubled_faces_weigh_nothing",
    ),
    16: (
        "double points",
        "io/test_unique.py::"
        "test_repeats_bias_neither_density_nor_cells_and_all_points_are_moved "
        "io/test_unique.py::test_tiles_that_overlap_are_counted_once",
    ),
    17: (
        "BOM, UTF-16",
        "io/test_obj.py::test_line_ends_and_byte_order_mark "
        "io/test_obj.py::test_malformed_files_are_refused_with_their_place "
        "io/test_xyz.py::test_what_is_wrong_is_refused_with_its_place",
    ),
    18: (
        "line ends",
        "io/test_obj.py::test_line_ends_and_byte_order_mark "
        "io/test_ply.py::test_text_may_have_blank_lines_and_any_line_end "
        "io/test_xyz.py::test_delimiters_headers_comments_and_line_ends",
    ),
    19: (
        "decimal comma",
        "io/test_obj.py::test_malformed_files_are_refused_with_their_place "
        "io/test_xyz.py::test_what_is_wrong_is_refused_with_its_place "
        "io/test_stl_off.py::test_broken_off io/test_colmap.py::test_bad_tables",
    ),
    20: (
        "NUL in text",
        "io/test_obj.py::test_malformed_files_are_refused_with_their_place "
        "io/test_obj.py::test_the_line_of_an_error_is_right_in_every_block "
        "io/test_xyz.py::test_what_is_wrong_is_refused_with_its_place",
    ),
    21: (
        "long line, many materials",
        "io/test_obj.py::test_a_line_without_end_is_refused "
        "io/test_obj.py::test_many_materials_and_pages_take_linear_time "
        "io/test_xyz.py::test_one_very_long_line_ends_soon",
    ),
    22: (
        "MTL missing",
        "io/test_obj.py::test_a_missing_material_file_leaves_the_geometry_and_says_so",
    ),
    23: (
        "texture page missing",
        "io/test_obj.py::test_a_missing_page_is_named_and_its_faces_have_none "
        "io/test_ply.py::test_missing_and_broken_pages_take_the_color_of_their_faces",
    ),
    24: (
        "case, backslash, spaces in names",
        "io/test_obj.py::test_names_are_found_however_they_are_spelt "
        "io/test_safe.py::test_a_reference_is_found_however_it_is_spelt",
    ),
    25: (
        "names beyond ASCII",
        "io/test_obj.py::test_names_in_latin_1 "
        "io/test_safe.py::test_names_of_other_bytes_are_found "
        "io/test_colmap.py::test_latin_1_names_do_not_stop_the_reading",
    ),
    26: (
        "map_Kd options",
        "io/test_obj.py::test_options_of_map_kd io/test_obj.py::test_other_options_are_refused",
    ),
    27: (
        "texture over 179 Mpx",
        "io/test_images.py::test_more_pixels_than_pillow_likes_are_opened "
        "io/test_images.py::test_a_page_of_more_rows_than_a_strip",
    ),
    28: (
        "image bomb",
        "io/test_images.py::test_too_many_pixels_are_told_by_the_header "
        "io/test_obj.py::test_a_bomb_of_a_page_is_refused_by_its_header",
    ),
    29: (
        "JPEG cut off",
        "io/test_images.py::test_a_truncated_page_is_refused_when_decoded "
        "raster/test_textures.py::"
        "test_a_page_that_fails_leaves_its_faces_uncolored_and_is_counted",
    ),
    30: (
        "16-bit and float texture",
        "io/test_images.py::test_color_png_of_sixteen_bits "
        "io/test_images.py::test_tiffs_of_many_bits_in_color",
    ),
    31: (
        "CMYK, palette, 1 bit",
        "io/test_images.py::test_pixel_modes io/test_images.py::test_converted_modes_are_noted",
    ),
    32: (
        "alpha channel",
        "io/test_images.py::test_alpha_of_deep_tiffs_is_kept "
        "raster/test_textures.py::test_transparent_texels_give_no_color_and_do_not_bleed",
    ),
    33: (
        "unseen faces of one color",
        "raster/test_finishing.py::test_fill_of_any_color_is_masked_and_counted "
        "cli/test_pairing.py::test_what_was_left_out_is_counted_and_small_shares_are_not",
    ),
    34: (
        "UV outside 0-1",
        "io/test_obj.py::test_texture_coordinates_outside_the_page "
        "io/test_ply.py::test_uv_outside_the_page_is_told "
        "raster/test_textures.py::test_coordinates_outside_the_page_wrap_or_clamp",
    ),
    35: (
        "several pages in a PLY",
        "io/test_ply.py::test_several_pages_by_texnumber "
        "io/test_ply.py::test_several_pages_without_texnumber_are_refused",
    ),
    36: (
        "UTM in 64 bits",
        "io/test_ply.py::test_large_coordinates_keep_their_millimetres "
        "io/test_obj.py::test_large_coordinates_keep_their_digits "
        "pipeline/test_pipeline.py::test_large_coordinates_change_nothing",
    ),
    37: (
        "UTM in 32 bits",
        "io/test_frames.py::test_coordinates_collapsed_by_32_bit_numbers_are_refused "
        "io/test_frames.py::test_32_bit_steps_must_not_tear_a_texture "
        "io/test_ply.py::test_large_single_precision_is_told_or_refused",
    ),
    38: (
        "shift in a file beside",
        "io/test_sidecar.py::test_pix4d_offset io/test_sidecar.py::test_a_prj_alone "
        "io/test_sidecar.py::test_odm_coords_in_the_sibling_folder "
        "io/test_sidecar.py::test_metashape_shift_txt "
        "io/test_sidecar.py::test_our_own_toml_says_everything "
        "io/test_sidecar.py::test_a_realitycapture_file_is_told",
    ),
    39: (
        "shifts that differ",
        "cli/test_pairing.py::test_a_lost_shift_leaves_one_local_frame "
        "cli/test_pairing.py::test_what_is_stated_stands_and_is_told "
        "cli/test_cli.py::test_a_lost_shift_is_made_up_for_and_said",
    ),
    40: (
        "Y-up against Z-up",
        "io/test_gltf.py::test_plainly_z_up_is_read_so_and_told "
        "cli/test_cli.py::test_info_measures_the_tilt "
        "cli/test_pairing.py::test_an_upright_survey_is_told",
    ),
    41: ("mirrored", "judge/test_judge.py::test_mirrored_and_turned_surveys_are_named"),
    42: ("other units", "cli/test_pairing.py::test_units_that_differ_are_named"),
    43: (
        "COLMAP frame not level",
        "io/test_colmap.py::test_model_comes_level_and_without_scale "
        "io/test_colmap.py::test_real_model_is_level",
    ),
    44: (
        "other horizontal CRS",
        "io/test_frames.py::test_the_moving_survey_goes_to_the_references_crs "
        "io/test_frames.py::test_a_badly_known_change_is_refused",
    ),
    45: (
        "CRS on one side only",
        "io/test_frames.py::"
        "test_a_missing_crs_is_local_and_said_with_scale_and_convergence "
        "cli/test_cli.py::test_a_crs_on_one_side_only_is_no_obstacle",
    ),
    46: (
        "vertical datum without a way",
        "io/test_frames.py::test_another_vertical_datum_without_a_known_way_is_refused",
    ),
    47: (
        "outside the CRS",
        "io/test_frames.py::test_coordinates_outside_their_crs_are_refused "
        "io/test_frames.py::test_points_that_proj_cannot_move_are_refused",
    ),
    48: (
        "PROJ_DATA wrong",
        "io/test_frames.py::test_a_wrong_proj_data_is_forgotten_with_a_note "
        "io/test_frames.py::test_a_wrong_proj_data_does_not_stop_a_change_of_crs "
        "cli/test_cli.py::test_doctor_sees_a_wrong_proj_data",
    ),
    49: (
        "no overlap",
        "judge/test_judge.py::test_another_place_is_rejected "
        "pipeline/test_pipeline.py::"
        "test_surveys_kilometres_apart_are_rejected_without_rasterizing_the_sea_between",
    ),
    50: (
        "overlap of 5-20 %",
        "pipeline/test_bad_input.py::test_a_narrow_overlap_is_never_accepted",
    ),
    51: (
        "ripples",
        "judge/test_judge.py::test_periodic_ground_is_not_accepted_at_the_wrong_crest",
    ),
    52: (
        "floaters",
        "raster/test_floaters.py::test_a_fish_half_a_metre_up_goes_and_is_counted "
        "raster/test_floaters.py::test_a_fish_in_a_cloud_goes",
    ),
    53: (
        "overhangs",
        "raster/test_drawing.py::test_the_highest_surface_wins_whatever_the_order "
        "raster/test_point_binning.py::test_what_lies_under_the_top_layer_is_left_out "
        "cli/test_pairing.py::test_what_was_left_out_is_counted_and_small_shares_are_not",
    ),
    54: (
        "holes",
        "raster/test_drawing.py::"
        "test_holes_stay_empty_and_cells_beside_them_keep_their_height "
        "raster/test_resampling.py::test_missing_cells_spread_no_further_than_themselves "
        "io/test_maps.py::test_missing_cells_neither_spread_nor_close",
    ),
    55: (
        "doming, scale",
        "deformation/test_warp.py::test_doming_is_named_and_measured "
        "deformation/test_warp.py::test_a_horizontal_bend_is_named_and_recovered",
    ),
    56: (
        "cloud without color",
        "judge/test_judge.py::test_terrain_alone_may_be_overwhelming "
        "io/test_cloud.py::test_a_local_cloud_is_local",
    ),
    57: ("LAS cut at a record", "io/test_cloud.py::test_a_file_cut_at_a_record_is_refused"),
    58: (
        "LAS counts huge",
        "io/test_cloud.py::test_a_lying_header_is_refused_before_memory_is_asked_for "
        "io/test_cloud.py::test_a_lying_count_of_a_laz_is_refused",
    ),
    59: (
        "LAS scale 0, offset NaN",
        "io/test_cloud.py::test_a_lying_header_is_refused_before_memory_is_asked_for",
    ),
    60: (
        "LAZ chunk damaged",
        "io/test_cloud.py::test_random_damage_reads_or_is_refused_and_nothing_else "
        "io/test_cloud.py::test_a_panic_below_python_becomes_an_input_error",
    ),
    61: ("E57 checksum", "io/test_e57.py::test_bad_checksum_is_said_plainly"),
    62: (
        "E57 with DOCTYPE",
        "io/test_e57.py::test_doctype_is_refused_before_the_library_sees_it "
        "io/test_e57.py::test_doctype_does_not_hide_in_another_encoding",
    ),
    63: (
        "COLMAP file missing or cut",
        "io/test_colmap.py::test_missing_files_are_named "
        "io/test_colmap.py::test_truncated_binaries_are_named "
        "io/test_colmap.py::test_lying_counts_never_reach_pycolmap",
    ),
    64: (
        "several COLMAP models",
        "io/test_colmap.py::test_several_models_are_listed_with_their_sizes",
    ),
    65: (
        "GLB lengths",
        "io/test_gltf.py::test_every_truncation_of_a_glb_is_refused "
        "io/test_gltf.py::test_lengths_must_be_exact "
        "io/test_gltf.py::test_broken_trees_are_refused_by_name",
    ),
    66: (
        "glTF accessor bomb",
        "io/test_gltf.py::test_accessor_bomb_asks_for_no_memory "
        "io/test_gltf.py::test_broken_trees_are_refused_by_name",
    ),
    67: (
        "glTF cycle and depth",
        "io/test_gltf.py::test_depth_of_the_tree_is_capped "
        "io/test_gltf.py::test_broken_trees_are_refused_by_name",
    ),
    68: (
        "glTF required extension",
        "io/test_gltf.py::test_broken_trees_are_refused_by_name",
    ),
    69: ("glTF uri", "io/test_gltf.py::test_uris_outside_the_folder_are_refused"),
    70: (
        "reference that escapes",
        "io/test_obj.py::test_references_out_of_the_folder_are_refused "
        "io/test_obj.py::test_a_linked_page_outside_is_refused "
        "io/test_safe.py::test_links_may_not_leave_the_folder "
        "io/test_safe.py::test_whatever_is_written_no_reference_leaves_the_root",
    ),
    71: (
        "pipe, device, folder",
        "io/test_front.py::test_a_pipe_is_refused_without_waiting "
        "io/test_front.py::test_a_device_is_refused "
        "io/test_safe.py::test_only_regular_files_are_opened",
    ),
    72: (
        "VRT called .tif",
        "io/test_maps.py::test_a_vrt_called_tif_is_refused "
        "io/test_images.py::test_a_vrt_under_another_name_reads_no_other_file",
    ),
    73: (
        "archives and foreign formats",
        "io/test_front.py::test_a_name_that_does_not_fit_the_content_is_refused",
    ),
    74: (
        "the same file twice",
        "io/test_front.py::test_the_same_bytes_twice_are_said "
        "cli/test_cli.py::test_same_file_twice_is_said",
    ),
    75: (
        "a file that changes",
        "io/test_front.py::test_a_file_that_changes_during_the_run_is_noticed "
        "io/test_front.py::test_a_file_that_belongs_to_a_survey_is_noticed_too "
        "io/test_front.py::test_a_file_that_changes_while_it_is_read_is_noticed "
        "cli/test_cli.py::test_input_that_changes_meanwhile_gives_no_output",
    ),
    76: (
        "disk full",
        "io/test_safe.py::test_atomic_file_survives_a_fault_at_every_call "
        "io/test_safe.py::test_atomic_folder_survives_a_fault_at_every_call "
        "cli/test_cli.py::test_full_disk_is_found_before_the_work",
    ),
    77: (
        "output read-only",
        "cli/test_cli.py::test_output_that_cannot_be_written_is_found_before_the_work",
    ),
    78: (
        "output exists",
        "cli/test_cli.py::test_existing_output_is_refused_then_replaced "
        "cli/test_cli.py::test_a_folder_of_somebody_elses_is_never_replaced",
    ),
    79: (
        "more memory than there is",
        "cli/test_pairing.py::test_rasters_larger_than_memory_are_refused_before_the_work "
        "raster/test_lattice.py::test_the_limit_names_its_numbers "
        "io/test_images.py::test_a_page_larger_than_memory_is_refused_before_decoding "
        "cli/test_cli.py::test_what_goes_wrong_is_one_message_and_no_output",
    ),
    80: (
        "signals",
        "cli/test_cli.py::test_signals_stop_the_job_and_leave_nothing "
        "cli/test_cli.py::test_second_signal_ends_at_once",
    ),
    81: (
        "two runs at once",
        "io/test_safe.py::test_a_second_run_is_kept_out_while_the_first_lives "
        "cli/test_cli.py::test_a_second_run_into_one_folder_is_refused",
    ),
    82: (
        "markup in names",
        "cli/test_cli.py::test_names_with_markup_are_shown_as_they_are",
    ),
}


@functools.cache
def functions(name: str) -> frozenset[str]:
    tree = ast.parse((TESTS / name).read_text())
    return frozenset(node.name for node in tree.body if isinstance(node, ast.FunctionDef))


def test_no_row_is_missing():
    assert list(ROWS) == list(range(1, 83))


@pytest.mark.parametrize(
    "names", [row[1] for row in ROWS.values()], ids=[f"{n} {row[0]}" for n, row in ROWS.items()]
)
def test_a_row_has_its_tests(names):
    for name in names.split():
        file, _, function = name.partition("::")
        assert function in functions(file)


def strip(raster, low, high):
    """Only what lies between two eastings, as if the survey ended there."""
    rows, cols = raster.grid.shape
    east, _ = raster.grid.east_north(0, np.arange(cols))
    inside = np.broadcast_to((east >= low) & (east <= high), (rows, cols))
    return dataclasses.replace(
        raster,
        height=np.where(inside, raster.height, np.nan),
        valid=raster.valid & inside,
        color=np.where(inside[..., None], raster.color, 0),
        color_valid=raster.color_valid & inside,
        samples=np.where(inside, raster.samples, 0),
    )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("width", [0.4, 0.8, 1.4])
def test_a_narrow_overlap_is_never_accepted(seed, width):
    """Two halves of the ground that share 5, 10 and 20 % of either: review at the best."""
    whole = pair(seed)
    rasters = {
        name: (strip(a, -9.0, width / 2), strip(b, -1.237 - width / 2, 9.0))
        for name, (a, b) in whole.items()
    }
    judged = verdict(rasters)
    assert judged.verdict in ("review", "rejected"), judged.reason
