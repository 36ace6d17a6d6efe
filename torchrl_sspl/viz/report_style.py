"""Style sheet of the report (one column, light and dark, tables that become cards on a phone), and what S, U and B are."""

#: The sets in a line each.
SETS = {
    "S": "green: states labelled safe",
    "U": "red: states labelled unsafe, never to be met",
    "B": "a number for what the camera shows; {B <= 0}, inside the black line, is the learned safe set, which the policy should not leave",
    "true kernel": "inside the dashed blue line: all states from which some policy avoids U for ever; the learned set should fill it, not leave it",
}


def picture(kernel: bool) -> str:
    """The sets as a sketch, in SVG, with the true kernel or without."""
    dashed = '<path d="M28 16H150C166 40 172 62 172 92H50C34 68 28 46 28 16z" fill="none" stroke="#1d4ed8" stroke-dasharray="5 3"/>'
    return (
        '<svg viewBox="0 0 200 108" role="img" aria-label="S inside the set {B &lt;= 0}, that inside the kernel, all outside of U">'
        '<rect width="200" height="108" fill="#fadcd7"/><rect x="28" y="16" width="144" height="76" fill="#fff"/>'
        f'{dashed if kernel else ""}<path d="M42 24H136C150 44 158 64 158 84H66C52 66 42 46 42 24z" fill="#eceef2" stroke="#111" '
        'stroke-width="2"/><rect x="82" y="42" width="40" height="26" fill="#cdeccd" stroke="#9a9a9a"/>'
        '<g font-size="12" fill="#222"><text x="97" y="59">S</text><text x="6" y="58">U</text><text x="51" y="38">B &lt;= 0</text></g></svg>'
    )



CSS = """
:root{--ink:#1a1f27;--soft:#5b6470;--page:#f6f7f9;--card:#fff;--line:#dde1e7;--good:#13702f;--good-bg:#e3f4e6;
--fair:#7a5200;--fair-bg:#fdf1d3;--bad:#b3261e;--bad-bg:#fce4e1;--none:#4b5563;--none-bg:#e8ebef}
@media(prefers-color-scheme:dark){:root{--ink:#e7eaee;--soft:#a3acb8;--page:#12151a;--card:#1b2027;--line:#323a45;
--good:#7ddb95;--good-bg:#16351f;--fair:#f1c765;--fair-bg:#3b2f10;--bad:#ff9d94;--bad-bg:#451a17;--none:#b6bec9;--none-bg:#2a313b}}
*{box-sizing:border-box}
body{margin:0;background:var(--page);color:var(--ink);font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
main{max-width:1000px;margin:0 auto;padding:24px 16px 64px}
h1{font-size:1.7rem;line-height:1.2;margin:0}h2{font-size:1.2rem;margin:0 0 .6rem}h3{font-size:.95rem;margin:0 0 .2rem}section>h3{margin-top:1.3rem}
.facts{color:var(--soft);margin:.25rem 0 1rem;font-size:.9rem}
section{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:18px;margin:0 0 18px;overflow-wrap:anywhere}
.verdict{border-left:8px solid var(--none)}.verdict h2{font-size:1.25rem;line-height:1.35}
.verdict.fair{border-left-color:var(--fair)}.verdict.fair h2{color:var(--fair)}
.verdict.good{border-left-color:var(--good)}.verdict.good h2{color:var(--good)}
.verdict.bad{border-left-color:var(--bad)}.verdict.bad h2{color:var(--bad)}
.columns{display:grid;grid-template-columns:2fr 3fr 2fr;gap:20px;font-size:.92rem}
.columns ul{list-style:none;padding:0}li.good b{color:var(--good)}li.fair b{color:var(--fair)}li.bad b{color:var(--bad)}
.sets{display:grid;grid-template-columns:180px 1fr;gap:18px;align-items:center;margin-top:14px;font-size:.9rem}
.sets svg{width:100%;height:auto;border-radius:6px}.sets dl{margin:0}.sets dt{float:left;font-weight:700;margin-right:.5em}.sets dd{margin:0 0 .2em}
.zoom{display:block;cursor:zoom-in}.zoom input{position:absolute;opacity:0}.zoom input:focus-visible+span{outline:3px solid var(--soft);display:block}
.zoom input:checked+span{position:fixed;inset:0;z-index:9;overflow:auto;background:#fff;cursor:zoom-out}
.zoom input:checked+span img{max-width:none;border-radius:0}
.columns li{margin:.35em 0}ul{margin:0;padding-left:1.1em}li{margin:.15em 0}
.scroll{overflow-x:auto}
table{border-collapse:collapse;width:100%;font-size:.9rem;font-variant-numeric:tabular-nums}
th,td{text-align:left;padding:.4em .6em;border-bottom:1px solid var(--line);vertical-align:top}
th{color:var(--soft);font-weight:600;white-space:nowrap}tbody tr:last-child td{border-bottom:0}
td{overflow-wrap:break-word}table.summary td:nth-child(n+2){white-space:nowrap}
code{font-size:.88em;overflow-wrap:anywhere}
.badge{display:inline-block;border-radius:6px;padding:.05em .5em;font-weight:600;background:var(--none-bg);color:var(--none)}
.badge.good{background:var(--good-bg);color:var(--good)}.badge.fair{background:var(--fair-bg);color:var(--fair)}
.badge.bad{background:var(--bad-bg);color:var(--bad)}
figure{margin:0 0 22px}figure:last-child{margin-bottom:0}
img,video{display:block;max-width:100%;height:auto;margin:0 auto;background:#fff;border-radius:8px}
figcaption{color:var(--soft);font-size:.9rem;margin-top:.4rem}figcaption b{color:var(--ink)}
summary{font-size:1.2rem;font-weight:700;cursor:pointer}details[open] summary{margin-bottom:.6rem}
@media(max-width:760px){main{padding:14px 8px 40px}section{padding:14px 12px}.columns{grid-template-columns:1fr;gap:12px}
.verdict h2{font-size:1.1rem}.sets{grid-template-columns:110px 1fr;gap:12px}
thead{display:none}table,tbody{display:block}tr{display:block;padding:.5em 0;border-bottom:1px solid var(--line)}tbody tr:last-child{border-bottom:0}
td,table.summary td:nth-child(n+2){display:flex;justify-content:space-between;gap:1em;border:0;padding:.1em 0;text-align:right;
white-space:normal;overflow-wrap:anywhere}td:empty{display:none}td::before{content:attr(data-label);color:var(--soft);text-align:left;flex:none}
td:first-child{display:block;text-align:left;font-weight:700}td:first-child::before{content:none}}
@media print{body{background:#fff}section{break-inside:avoid}}
"""
