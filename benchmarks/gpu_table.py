def gpu_table(state): return ""
def short_table(state): return "\n".join(f"{s} {r['name']} {r['status']} {r.get('ok')} {r.get('error')} {r.get('bound')} {r.get('gradient_error')} {r.get('why','')}" for s,x in state["sections"].items() for r in x["rows"])
