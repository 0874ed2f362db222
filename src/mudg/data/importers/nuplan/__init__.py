"""nuPlan."""
