"""Reports on a cleaned take: the JSON and HTML reports, their notes, and the rerun recording.

- `report`: the JSON report: typed sections with stable keys
- `build_report`: its sections, from what the stages returned; notes, terms (their wording)
- `sample_states`: a take before and after cleaning, and the state of every sample
- `html_report`: the HTML report: change_figures, stick_figures, timeline
- `contact_sheet`: pictures of the body, and of a character beside it
- `recording`: the rerun recording
"""
