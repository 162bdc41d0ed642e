"""Types of the configuration's slices: made from schemas/config.schema.yaml by docs/make_settings.py.

A settings object is the validated configuration, or slices of it, as a rule passes them on. What a key means, its unit
and its default stand in config/README.md.
"""

# ruff: noqa: UP013 (mappings, not classes)

from __future__ import annotations

from typing import TypedDict

PaperGapSettings = TypedDict(
    "PaperGapSettings",
    {
        "phantom": str,
        "study_robot": str,
        "largest": float,
        "draws": int,
        "method": str,
        "restarts": int,
        "timestep_s": float,
        "j_tolerance": float,
        "class_resamples": int,
        "resamples": int,
        "not_told_apart": float,
    },
)

PathsSettings = TypedDict(
    "PathsSettings",
    {
        "subjects": str,
        "robot": str,
        "phantom": str,
        "published": str,
    },
)

IngestSkinSettings = TypedDict(
    "IngestSkinSettings",
    {
        "carried_m_per_rad": float,
        "carried_per_stretch": float,
        "most_twist_rad": float,
    },
)

IngestUnitsPelvisAnglesSettings = TypedDict(
    "IngestUnitsPelvisAnglesSettings",
    {
        "markers_moved_deg": float,
        "markerless_moved_deg": float,
        "ratio": float,
        "travel_ratio": float,
    },
)

IngestUnitsSettings = TypedDict(
    "IngestUnitsSettings",
    {
        "marker_extent_m": list[float],
        "largest_angle_deg": float,
        "pelvis_angles": IngestUnitsPelvisAnglesSettings,
        "thousand": list[float],
        "arm_lift_m": float,
        "arm_angle_rad": float,
    },
)

IngestFrozenSettings = TypedDict(
    "IngestFrozenSettings",
    {
        "frames": int,
        "moved_steps": float,
    },
)

IngestSwapSettings = TypedDict(
    "IngestSwapSettings",
    {
        "violation_m": float,
        "restored_m": float,
    },
)

IngestMarkerlessSettings = TypedDict(
    "IngestMarkerlessSettings",
    {
        "min_correlation": float,
        "drift_report_ms_per_min": float,
        "drift_certainty_sd": float,
        "translations": list[str],
        "rotations": list[str],
    },
)

IngestRobotLogStampsSettings = TypedDict(
    "IngestRobotLogStampsSettings",
    {
        "same_clock_s": float,
        "usable_share": float,
        "delay_warn_s": float,
    },
)

IngestRobotLogSettings = TypedDict(
    "IngestRobotLogSettings",
    {
        "min_correlation": float,
        "least_s": float,
        "stamps": IngestRobotLogStampsSettings,
    },
)

IngestLabToWorldSettings = TypedDict(
    "IngestLabToWorldSettings",
    {
        "x": str,
        "y": str,
        "z": str,
    },
)

IngestSettings = TypedDict(
    "IngestSettings",
    {
        "rate_hz": float,
        "cutoff_hz": float,
        "filter_order": int,
        "max_gap_s": float,
        "min_complete": float,
        "skin": IngestSkinSettings,
        "max_marker_jump_m": float,
        "units": IngestUnitsSettings,
        "frozen": IngestFrozenSettings,
        "swap": IngestSwapSettings,
        "markerless": IngestMarkerlessSettings,
        "robot_log": IngestRobotLogSettings,
        "facing_deg": float,
        "lab_to_world": IngestLabToWorldSettings,
    },
)

QualityCompletenessSettings = TypedDict(
    "QualityCompletenessSettings",
    {
        "warn": float,
        "refuse": float,
    },
)

QualityGapsSettings = TypedDict(
    "QualityGapsSettings",
    {
        "warn": float,
        "refuse": float,
    },
)

QualityRigidSettings = TypedDict(
    "QualityRigidSettings",
    {
        "warn": float,
        "refuse": float,
    },
)

QualitySpikesSettings = TypedDict(
    "QualitySpikesSettings",
    {
        "height_m": float,
        "warn": float,
        "refuse": float,
    },
)

QualityRateSettings = TypedDict(
    "QualityRateSettings",
    {
        "common_hz": list[float],
        "better_by": float,
        "min_correlation": float,
        "warn": float,
        "refuse": float,
    },
)

QualitySpacingSettings = TypedDict(
    "QualitySpacingSettings",
    {
        "warn": float,
        "refuse": float,
    },
)

QualityRobotSyncSettings = TypedDict(
    "QualityRobotSyncSettings",
    {
        "certain_s": float,
        "warn": float,
        "refuse": float,
    },
)

QualityRobotDriftSettings = TypedDict(
    "QualityRobotDriftSettings",
    {
        "certainty_sd": float,
        "pooled_certainty_sd": float,
        "warn": float,
        "refuse": float,
    },
)

QualityRobotResidualSettings = TypedDict(
    "QualityRobotResidualSettings",
    {
        "warn": float,
        "refuse": float,
    },
)

QualityMarkerlessSyncSettings = TypedDict(
    "QualityMarkerlessSyncSettings",
    {
        "warn": float,
        "refuse": float,
    },
)

QualityMarkerlessDriftSettings = TypedDict(
    "QualityMarkerlessDriftSettings",
    {
        "certainty_sd": float,
        "pooled_certainty_sd": float,
        "warn": float,
        "refuse": float,
    },
)

QualityMarkerlessResidualSettings = TypedDict(
    "QualityMarkerlessResidualSettings",
    {
        "warn": float,
        "refuse": float,
    },
)

QualityFrameRobotSettings = TypedDict(
    "QualityFrameRobotSettings",
    {
        "certain_deg": float,
        "warn": float,
        "refuse": float,
    },
)

QualityFrameMarkerlessSettings = TypedDict(
    "QualityFrameMarkerlessSettings",
    {
        "warn": float,
        "refuse": float,
    },
)

QualityExcitationSettings = TypedDict(
    "QualityExcitationSettings",
    {
        "range_m": float,
        "range_deg": float,
        "reversals": int,
        "warn": float,
        "refuse": float,
    },
)

QualityLimitsSettings = TypedDict(
    "QualityLimitsSettings",
    {
        "margin": float,
        "warn": float,
        "refuse": float,
    },
)

QualityNoiseSettings = TypedDict(
    "QualityNoiseSettings",
    {
        "warn": float,
        "refuse": float,
    },
)

QualityLengthSettings = TypedDict(
    "QualityLengthSettings",
    {
        "warn": float,
        "refuse": float,
    },
)

QualityStillSettings = TypedDict(
    "QualityStillSettings",
    {
        "band_hz": float,
        "range_m": float,
        "range_deg": float,
        "warn": float,
        "refuse": float,
    },
)

QualitySameSettings = TypedDict(
    "QualitySameSettings",
    {
        "least_difference": float,
        "least_s": float,
        "least_correlation": float,
        "shape_m": float,
    },
)

QualityExchangedSettings = TypedDict(
    "QualityExchangedSettings",
    {
        "suspect": float,
        "certainty_sd": float,
        "least_s": float,
    },
)

QualityRobotPairSettings = TypedDict(
    "QualityRobotPairSettings",
    {
        "least_motion_m": float,
        "warn": float,
        "refuse": float,
    },
)

QualityMarkerlessPairSettings = TypedDict(
    "QualityMarkerlessPairSettings",
    {
        "lever_m": float,
        "least_motion_m": float,
        "warn": float,
        "refuse": float,
    },
)

QualityScaleSettings = TypedDict(
    "QualityScaleSettings",
    {
        "least_s": float,
        "warn": float,
        "refuse": float,
    },
)

QualitySettings = TypedDict(
    "QualitySettings",
    {
        "override": dict[str, str],
        "completeness": QualityCompletenessSettings,
        "gaps": QualityGapsSettings,
        "rigid": QualityRigidSettings,
        "spikes": QualitySpikesSettings,
        "rate": QualityRateSettings,
        "spacing": QualitySpacingSettings,
        "robot_sync": QualityRobotSyncSettings,
        "robot_drift": QualityRobotDriftSettings,
        "robot_residual": QualityRobotResidualSettings,
        "markerless_sync": QualityMarkerlessSyncSettings,
        "markerless_drift": QualityMarkerlessDriftSettings,
        "markerless_residual": QualityMarkerlessResidualSettings,
        "frame_robot": QualityFrameRobotSettings,
        "frame_markerless": QualityFrameMarkerlessSettings,
        "excitation": QualityExcitationSettings,
        "limits": QualityLimitsSettings,
        "noise": QualityNoiseSettings,
        "length": QualityLengthSettings,
        "still": QualityStillSettings,
        "same": QualitySameSettings,
        "exchanged": QualityExchangedSettings,
        "robot_pair": QualityRobotPairSettings,
        "markerless_pair": QualityMarkerlessPairSettings,
        "scale": QualityScaleSettings,
    },
)

RobotHoldXSettings = TypedDict(
    "RobotHoldXSettings",
    {
        "stiffness": float,
        "damping": float,
    },
)

RobotHoldYSettings = TypedDict(
    "RobotHoldYSettings",
    {
        "stiffness": float,
        "damping": float,
    },
)

RobotHoldYawSettings = TypedDict(
    "RobotHoldYawSettings",
    {
        "stiffness": float,
        "damping": float,
    },
)

RobotHoldSettings = TypedDict(
    "RobotHoldSettings",
    {
        "x": RobotHoldXSettings,
        "y": RobotHoldYSettings,
        "yaw": RobotHoldYawSettings,
    },
)

RobotArmLiftSettings = TypedDict(
    "RobotArmLiftSettings",
    {
        "stiffness": float,
        "damping": float,
    },
)

RobotArmRollSettings = TypedDict(
    "RobotArmRollSettings",
    {
        "stiffness": float,
        "damping": float,
    },
)

RobotArmPitchSettings = TypedDict(
    "RobotArmPitchSettings",
    {
        "stiffness": float,
        "damping": float,
    },
)

RobotArmSettings = TypedDict(
    "RobotArmSettings",
    {
        "lift": RobotArmLiftSettings,
        "roll": RobotArmRollSettings,
        "pitch": RobotArmPitchSettings,
    },
)

RobotSettings = TypedDict(
    "RobotSettings",
    {
        "hold": RobotHoldSettings,
        "arm": RobotArmSettings,
    },
)

PlantStudySettings = TypedDict(
    "PlantStudySettings",
    {
        "candidates_s": list[float],
        "reference_s": float,
        "draws": int,
        "seed": int,
        "marker_rms_m": float,
        "J_relative": float,
    },
)

PlantReplayBarSettings = TypedDict(
    "PlantReplayBarSettings",
    {
        "rms_m": float,
        "lag_s": float,
    },
)

PlantSettings = TypedDict(
    "PlantSettings",
    {
        "timestep_s": str | float,
        "study": PlantStudySettings,
        "limit_solref": list[float],
        "limit_solimp": list[float],
        "replay_bar": PlantReplayBarSettings,
    },
)

IdentificationLeastSquaresSettings = TypedDict(
    "IdentificationLeastSquaresSettings",
    {
        "screen": int,
        "iterations": int,
        "ftol": float,
    },
)

IdentificationScalesSettings = TypedDict(
    "IdentificationScalesSettings",
    {
        "position_m": float,
        "velocity_m_per_s": float,
    },
)

IdentificationBoundsSettings = TypedDict(
    "IdentificationBoundsSettings",
    {
        "k_tx": list[float],
        "k_ty": list[float],
        "k_tz": list[float],
        "k_rx": list[float],
        "k_ry": list[float],
        "k_rz": list[float],
        "d_tx": list[float],
        "d_ty": list[float],
        "d_tz": list[float],
        "d_rx": list[float],
        "d_ry": list[float],
        "d_rz": list[float],
    },
)

IdentificationSettings = TypedDict(
    "IdentificationSettings",
    {
        "method": str,
        "restarts": int,
        "evaluations": int,
        "population": int,
        "sigma0": float,
        "tolfun": float,
        "diagonal_iterations": int,
        "least_squares": IdentificationLeastSquaresSettings,
        "seed": int,
        "scales": IdentificationScalesSettings,
        "start_window_s": float,
        "start_known_share": float,
        "settle_after_gap_s": float,
        "at_bound_ln": float,
        "bounds": IdentificationBoundsSettings,
    },
)

IdentifiabilitySettings = TypedDict(
    "IdentifiabilitySettings",
    {
        "determined_sd_ln": float,
        "weak_sd_ln": float,
        "at_bound_ln": float,
        "autocorrelation_s": float,
        "step_ln": float,
        "iterations": int,
        "profile_iterations": int,
        "floor_block_s": float,
        "floor_bootstrap": int,
        "bias_draws": int,
        "bias_iterations": int,
        "bias_step_ln": float,
        "seed": int,
    },
)

RefinementSettings = TypedDict(
    "RefinementSettings",
    {
        "priors": str,
        "interval": str,
        "also_free": list[str],
        "compare": str,
    },
)

DiagnosisNoiseSettings = TypedDict(
    "DiagnosisNoiseSettings",
    {
        "standing_hz": list[float],
        "log_moving_hz": list[list[float]],
        "edges_hz": list[float],
        "cutoff_margin": float,
        "least_highest_hz": float,
        "least_passed": float,
        "narrowest_band": float,
        "passes": float,
        "samples_per_period": float,
        "least_freedom": float,
        "marker_floor_m": float,
        "robot_floor": list[float],
        "floor_rate_hz": float,
        "window_s": float,
        "smallest_m": float,
        "least_telling": float,
        "slow_certainty": float,
        "louder_certainty": float,
    },
)

DiagnosisJumpsSettings = TypedDict(
    "DiagnosisJumpsSettings",
    {
        "fast_hz": float,
        "path_sd": float,
        "residual_sd": float,
        "least_usual_m": float,
        "smear_s": float,
        "ghost_sd": float,
        "ghost_m": float,
        "ghost_smear_s": float,
        "edge_s": float,
        "smear_cutoff_hz": float,
    },
)

DiagnosisStartSettings = TypedDict(
    "DiagnosisStartSettings",
    {
        "first_s": float,
        "moved_sd": float,
    },
)

DiagnosisSkinSettings = TypedDict(
    "DiagnosisSkinSettings",
    {
        "span_s": float,
        "fewest_spans": int,
        "smallest_sd_m": float,
    },
)

DiagnosisPelvisSettings = TypedDict(
    "DiagnosisPelvisSettings",
    {
        "smoothing_hz": float,
        "smoothing_share": float,
        "level_share": float,
        "line_coefficients": int,
        "loud_power": float,
        "lowest_cutoff_hz": float,
    },
)

DiagnosisNuisanceSettings = TypedDict(
    "DiagnosisNuisanceSettings",
    {
        "log_latency_sd_s": float,
        "odometry_scale_sd": float,
        "log_cutoff_hz": float,
    },
)

DiagnosisDescribedChannelsSettings = TypedDict(
    "DiagnosisDescribedChannelsSettings",
    {
        "samples_per_period": float,
        "clipped_share": float,
        "clipped_stretches": int,
        "least_levels": float,
        "most_scale": float,
        "bound_share": float,
        "step_sd": float,
        "step_chi2_sd": float,
        "most_step_parts": int,
    },
)

DiagnosisDescribedSettings = TypedDict(
    "DiagnosisDescribedSettings",
    {
        "band_shares": list[float],
        "marker_floor_m": float,
        "channels": DiagnosisDescribedChannelsSettings,
        "spike_sd": float,
        "first_s": float,
        "moved_sd": float,
        "still_s": float,
        "least_quiet_s": float,
        "rate_share": float,
    },
)

DiagnosisSearchSettings = TypedDict(
    "DiagnosisSearchSettings",
    {
        "screen": int,
        "first_iterations": int,
        "iterations": int,
        "ftol": float,
        "final_iterations": int,
        "final_ftol": float,
        "final_refits": int,
        "corrected_draws": int,
        "corrected_iterations": int,
        "corrected_longest_ln": float,
        "corrected_enough_sd": float,
        "corrected_near_ln": float,
        "corrected_least_share": float,
        "certain_unknown": float,
        "equilibrium_share": float,
        "keep_jacobian": float,
        "longest_step": float,
        "strengths": int,
        "strengths_between": int,
        "weakenings": int,
        "questionable_probability": float,
        "quiet_refits": int,
        "out_of_reach": float,
        "nearly_all": float,
        "far_behind": float,
        "refits": int,
        "refits_close": int,
        "close_factor": float,
        "pair_excess_sigma": float,
        "pair_pool": int,
        "pair_screens": int,
        "pair_refits": int,
        "pair_rivals": int,
        "spread_refits": int,
        "swap_refits": int,
        "redraws": int,
        "redraw_refits": int,
        "redraw_range_ln": float,
        "many_constants": int,
        "most_effects": int,
        "grow_share": float,
        "seed": int,
    },
)

DiagnosisFreeFormSettings = TypedDict(
    "DiagnosisFreeFormSettings",
    {
        "band_share": float,
        "refits": int,
        "most": int,
        "promising": int,
        "least_closed": float,
        "main_share": float,
    },
)

DiagnosisCalibrationSettings = TypedDict(
    "DiagnosisCalibrationSettings",
    {
        "overdispersion": float,
        "inexact_ways": float,
        "noise_share": float,
        "cause_log_odds": float,
        "further_log_odds": float,
        "even_share": float,
        "share_power": float,
        "unlisted_odds": float,
        "ambiguous_share": float,
        "ambiguity_probability": float,
    },
)

DiagnosisReportSettings = TypedDict(
    "DiagnosisReportSettings",
    {
        "plant_sd_ln": float,
        "least_size_share": float,
        "interval_probability": float,
        "detailed_causes": int,
        "smallest_gap": float,
        "axis_share": float,
        "next_trial_certain": float,
        "next_trial_axes": int,
        "visible": list[str],
    },
)

DiagnosisSettings = TypedDict(
    "DiagnosisSettings",
    {
        "robot_holds": str,
        "robots": dict[str, str],
        "left_out": list[str],
        "noise_draws": int,
        "noise": DiagnosisNoiseSettings,
        "crossed_limit_share": float,
        "jumps": DiagnosisJumpsSettings,
        "start": DiagnosisStartSettings,
        "skin": DiagnosisSkinSettings,
        "pelvis": DiagnosisPelvisSettings,
        "nuisance": DiagnosisNuisanceSettings,
        "described": DiagnosisDescribedSettings,
        "search": DiagnosisSearchSettings,
        "free_form": DiagnosisFreeFormSettings,
        "calibration": DiagnosisCalibrationSettings,
        "report": DiagnosisReportSettings,
    },
)

TwinHumanContactSettings = TypedDict(
    "TwinHumanContactSettings",
    {
        "friction": float,
        "solref": list[float],
        "solimp": list[float],
    },
)

TwinHumanSettings = TypedDict(
    "TwinHumanSettings",
    {
        "timestep_s": float,
        "substeps": int,
        "contact": TwinHumanContactSettings,
    },
)

TwinReferenceRolloverSettings = TypedDict(
    "TwinReferenceRolloverSettings",
    {
        "heel_off": float,
        "foot_flat": float,
        "ball_off": float,
    },
)

TwinReferenceWeightsSettings = TypedDict(
    "TwinReferenceWeightsSettings",
    {
        "translation_m": float,
        "shape_rad": float,
        "offset_rad": float,
        "speed_m_per_s": float,
        "height_m": float,
        "data": float,
    },
)

TwinReferenceSpeedsSettings = TypedDict(
    "TwinReferenceSpeedsSettings",
    {
        "shares": list[float],
        "speed_m_per_s": float,
        "knee_exponent": float,
        "ankle_exponent": float,
        "cadence_from": str,
        "cadence_exponent": float,
    },
)

TwinReferenceSettings = TypedDict(
    "TwinReferenceSettings",
    {
        "stance": float,
        "rollover": TwinReferenceRolloverSettings,
        "slip_m_per_s": float,
        "height_m": float,
        "clearance_m": float,
        "landing_m_per_s": float,
        "peak_bw": float,
        "pressure_m": float,
        "weights": TwinReferenceWeightsSettings,
        "step_half_width_m": float,
        "arm_swing_deg": float,
        "arm_swing_phase": float,
        "arm_abduction_deg": float,
        "elbow_deg": float,
        "iterations": int,
        "speeds": TwinReferenceSpeedsSettings,
    },
)

TwinTrainingPushSustainedSettings = TypedDict(
    "TwinTrainingPushSustainedSettings",
    {
        "share": float,
        "force_n": float,
        "lasts_s": list[float],
    },
)

TwinTrainingPushSettings = TypedDict(
    "TwinTrainingPushSettings",
    {
        "force_n": float,
        "margin": float,
        "ramp_n": float,
        "gate_s": float,
        "every_s": list[float],
        "lasts_s": list[float],
        "sustained": TwinTrainingPushSustainedSettings,
    },
)

TwinTrainingSpeedsSettings = TypedDict(
    "TwinTrainingSpeedsSettings",
    {
        "range": list[float],
        "own": float,
        "held_knows": float,
        "lead": list[float],
        "changes": float,
        "rate_per_s": float,
    },
)

TwinTrainingHoldDampingSettings = TypedDict(
    "TwinTrainingHoldDampingSettings",
    {
        "along": float,
        "lateral": float,
        "vertical": float,
        "roll": float,
        "pitch": float,
        "yaw": float,
    },
)

TwinTrainingHoldStiffnessSettings = TypedDict(
    "TwinTrainingHoldStiffnessSettings",
    {
        "lateral": float,
        "vertical": float,
        "roll": float,
        "pitch": float,
    },
)

TwinTrainingHoldStopsRobotLateralSettings = TypedDict(
    "TwinTrainingHoldStopsRobotLateralSettings",
    {
        "stiffness": float,
        "damping": float,
    },
)

TwinTrainingHoldStopsRobotYawSettings = TypedDict(
    "TwinTrainingHoldStopsRobotYawSettings",
    {
        "stiffness": float,
        "damping": float,
    },
)

TwinTrainingHoldStopsRobotSettings = TypedDict(
    "TwinTrainingHoldStopsRobotSettings",
    {
        "lateral": TwinTrainingHoldStopsRobotLateralSettings,
        "yaw": TwinTrainingHoldStopsRobotYawSettings,
    },
)

TwinTrainingHoldStopsSettings = TypedDict(
    "TwinTrainingHoldStopsSettings",
    {
        "share": float,
        "along_m": float,
        "lateral_m": float,
        "yaw_deg": float,
        "stiffness": float,
        "damping": float,
        "yaw_stiffness": float,
        "force_cap_n": float,
        "distance_gain_per_s": float,
        "robot": TwinTrainingHoldStopsRobotSettings,
    },
)

TwinTrainingHoldSettings = TypedDict(
    "TwinTrainingHoldSettings",
    {
        "share": float,
        "damping": TwinTrainingHoldDampingSettings,
        "stiffness": TwinTrainingHoldStiffnessSettings,
        "speed": list[float],
        "yaw_inertia": float,
        "towed": float,
        "stops": TwinTrainingHoldStopsSettings,
    },
)

TwinTrainingRewardSettings = TypedDict(
    "TwinTrainingRewardSettings",
    {
        "pose": float,
        "pose_sharpness": float,
        "force": float,
        "force_from_bw": float,
        "speed": float,
        "slip": float,
    },
)

TwinTrainingPpoSettings = TypedDict(
    "TwinTrainingPpoSettings",
    {
        "hidden": list[int],
        "gamma": float,
        "lambda": float,
        "clip": float,
        "epochs": int,
        "minibatches": int,
        "kl": float,
        "actor_rate": float,
        "actor_rate_range": list[float],
        "critic_rate": float,
        "std": float,
        "std_floor": float,
        "averaged_updates": int,
    },
)

TwinTrainingSettings = TypedDict(
    "TwinTrainingSettings",
    {
        "substeps": int,
        "simulations": int,
        "horizon": int,
        "episode_s": float,
        "steps": float,
        "processor_s": float,
        "evaluate_from_steps": float,
        "evaluate_every_steps": float,
        "evaluate_push_minutes": float,
        "passes": int,
        "normaliser_iterations": int,
        "reward_scale": float,
        "report_s": float,
        "push": TwinTrainingPushSettings,
        "speeds": TwinTrainingSpeedsSettings,
        "hold": TwinTrainingHoldSettings,
        "reward": TwinTrainingRewardSettings,
        "ppo": TwinTrainingPpoSettings,
    },
)

TwinEvaluationSettings = TypedDict(
    "TwinEvaluationSettings",
    {
        "walkers": int,
        "shares": list[float],
        "walk_s": float,
        "settle_s": float,
        "push_minutes": float,
        "push_n": list[float],
        "battery_n": float,
        "battery_s": float,
        "battery_after_s": float,
    },
)

TwinAcceptanceRomErrorDegSettings = TypedDict(
    "TwinAcceptanceRomErrorDegSettings",
    {
        "hip_flexion": float,
        "knee_angle": float,
        "ankle_angle": float,
    },
)

TwinAcceptancePeakErrorDegSettings = TypedDict(
    "TwinAcceptancePeakErrorDegSettings",
    {
        "hip_flexion": float,
        "knee_angle": float,
        "ankle_angle": float,
    },
)

TwinAcceptanceRSettings = TypedDict(
    "TwinAcceptanceRSettings",
    {
        "hip_flexion": float,
        "knee_angle": float,
        "ankle_angle": float,
    },
)

TwinAcceptanceRmseDegSettings = TypedDict(
    "TwinAcceptanceRmseDegSettings",
    {
        "hip_flexion": float,
        "knee_angle": float,
        "ankle_angle": float,
    },
)

TwinAcceptanceSettings = TypedDict(
    "TwinAcceptanceSettings",
    {
        "speed_error": float,
        "rom_error_deg": TwinAcceptanceRomErrorDegSettings,
        "peak_error_deg": TwinAcceptancePeakErrorDegSettings,
        "r": TwinAcceptanceRSettings,
        "rmse_deg": TwinAcceptanceRmseDegSettings,
        "floor_force_bw": float,
        "saturated_share": float,
        "falls_per_minute": float,
        "battery_share": float,
    },
)

TwinFollowLateralSettings = TypedDict(
    "TwinFollowLateralSettings",
    {
        "stiffness": float,
        "damping": float,
        "source": str,
    },
)

TwinFollowYawSettings = TypedDict(
    "TwinFollowYawSettings",
    {
        "stiffness": float,
        "damping": float,
        "source": str,
    },
)

TwinFollowVerticalSettings = TypedDict(
    "TwinFollowVerticalSettings",
    {
        "stiffness": float,
        "damping": float,
        "source": str,
    },
)

TwinFollowRollSettings = TypedDict(
    "TwinFollowRollSettings",
    {
        "stiffness": float,
        "damping": float,
        "source": str,
    },
)

TwinFollowPitchSettings = TypedDict(
    "TwinFollowPitchSettings",
    {
        "stiffness": float,
        "damping": float,
        "source": str,
    },
)

TwinFollowSettings = TypedDict(
    "TwinFollowSettings",
    {
        "speed_gain": float,
        "force_cap_n": float,
        "speed_filter_s": float,
        "distance_gain_per_s": float,
        "lateral": TwinFollowLateralSettings,
        "yaw": TwinFollowYawSettings,
        "vertical": TwinFollowVerticalSettings,
        "roll": TwinFollowRollSettings,
        "pitch": TwinFollowPitchSettings,
    },
)

TwinStudyRobotSettings = TypedDict(
    "TwinStudyRobotSettings",
    {
        "model": str,
        "stop_distance_m": float,
        "full_distance_m": float,
        "full_speed_m_per_s": float,
        "reach_m": float,
        "straight_deg": float,
        "arc_share": float,
        "yaw_from_deg": float,
        "yaw_full_deg": float,
        "yaw_speed_m_per_s": float,
        "yaw_share": float,
        "wheel_p": float,
        "wheel_i": float,
        "gear": float,
        "axle_damping": float,
        "wheel_force_cap_n": float,
        "grip": float,
    },
)

TwinCoupledSoftSettings = TypedDict(
    "TwinCoupledSoftSettings",
    {
        "stiffness": float,
        "damping": float,
    },
)

TwinCoupledStiffSettings = TypedDict(
    "TwinCoupledStiffSettings",
    {
        "stiffness": float,
        "damping": float,
    },
)

TwinCoupledSettings = TypedDict(
    "TwinCoupledSettings",
    {
        "walkers": int,
        "walk_s": float,
        "settle_s": float,
        "speed_caps": list[float],
        "robots": list[str],
        "cap_from": str,
        "main_cap": float,
        "soft": TwinCoupledSoftSettings,
        "stiff": TwinCoupledStiffSettings,
        "sensitivity": list[float],
        "study_sensitivity": list[float],
        "gaits": list[str],
        "stopping_pull_bw": float,
        "pull_sense_s": float,
        "cadence_exponent": float,
    },
)

TwinSettings = TypedDict(
    "TwinSettings",
    {
        "cohort": str,
        "seeds": list[int],
        "human": TwinHumanSettings,
        "reference": TwinReferenceSettings,
        "training": TwinTrainingSettings,
        "evaluation": TwinEvaluationSettings,
        "acceptance": TwinAcceptanceSettings,
        "follow": TwinFollowSettings,
        "study_robot": TwinStudyRobotSettings,
        "coupled": TwinCoupledSettings,
    },
)

TightnessSettings = TypedDict(
    "TightnessSettings",
    {
        "alpha": float,
        "bootstrap": int,
        "permutations": int,
        "min_levels": int,
        "seed": int,
    },
)

StatisticsRegressionSettings = TypedDict(
    "StatisticsRegressionSettings",
    {
        "predictors": list[str],
        "people_per_predictor": int,
    },
)

StatisticsStudySettings = TypedDict(
    "StatisticsStudySettings",
    {
        "draws": int,
        "bootstrap": int,
        "people": list[int],
        "power_people": list[int],
        "seed": int,
    },
)

StatisticsSettings = TypedDict(
    "StatisticsSettings",
    {
        "bootstrap": int,
        "confidence": float,
        "common_below": float,
        "distinct_from": float,
        "min_subjects": int,
        "seed": int,
        "regression": StatisticsRegressionSettings,
        "study": StatisticsStudySettings,
    },
)

Settings = TypedDict(
    "Settings",
    {
        "cohort": str,
        "diagnosed": str,
        "suite": str,
        "paper_gap": PaperGapSettings,
        "paths": PathsSettings,
        "ingest": IngestSettings,
        "quality": QualitySettings,
        "robot": RobotSettings,
        "plant": PlantSettings,
        "identification": IdentificationSettings,
        "identifiability": IdentifiabilitySettings,
        "refinement": RefinementSettings,
        "diagnosis": DiagnosisSettings,
        "twin": TwinSettings,
        "tightness": TightnessSettings,
        "statistics": StatisticsSettings,
    },
)
